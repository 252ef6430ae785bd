/* Everything is made larger together: the pictures stay, and an anchor alone tells the size. */
const MOTION = { tx: 1, yaw: -10 },
  CORNER = 1,
  FRONT = [0, 1];

function scaleNumbers({ k, B, W }, anchor) {
  const motion = motionOf({ ...MOTION, tx: k * MOTION.tx }),
    corners = SCENE.corners.map((corner) => scaled(corner, k));
  const measured = {
    baseline: norm(motion.t),
    width: norm(minus(corners[FRONT[0]], corners[FRONT[1]])),
    distance: norm(scaled(corners.reduce(plus), 1 / corners.length)),
  };
  const meters = { none: NaN, baseline: B / measured.baseline, width: W / measured.width }[anchor];
  const factor = Number.isNaN(meters) ? 1 : meters;
  for (const name of Object.keys(measured)) measured[name] *= factor;
  const [u1, u2] = [HERE, motion].map((where) => project(moved(where, corners[CORNER]))[0]);
  return { motion, corners, u1, u2, ...measured, meters, drawn: k * factor };
}

function drawPictures({ motion, corners }) {
  const inside = twoPictures("pictures", [WORDS.first, WORDS.second]);
  [HERE, motion].forEach((where, n) => {
    drawHouse(inside[n], corners, where);
    const [x, y] = project(moved(where, corners[CORNER]));
    add(inside[n], "circle", { class: ["one", "other"][n], cx: x, cy: y, r: 9 });
  });
}

/* Scales of the drawing, meters from top to bottom; without an anchor it stays, so that what grows is seen to grow. */
const REACHES = [3, 8, 22, 60, 160];

function drawAbove({ drawn, baseline }, unit) {
  const farthest = drawn * Math.max(...SCENE.corners.map(([, , z]) => z)),
    enough = (reach) => reach >= 1.1 * farthest && (unit === "m" || reach >= 22);
  const [svg, width] = fitted("above", 420),
    reach = REACHES.find(enough) || REACHES.at(-1),
    size = 384 / reach;
  const toPlace = ([x, , z]) => [0.42 * width + size * x, 402 - size * z];
  for (const z of marks(reach, 4).slice(1)) {
    const y = toPlace([0, 0, z])[1];
    add(svg, "line", { class: "grid", x1: 12, x2: width - 12, y1: y, y2: y });
    add(svg, "text", { class: "tick", x: width - 14, y: y - 4, "text-anchor": "end" }, `${z} ${unit}`);
  }
  const corners = SCENE.corners.map((corner) => scaled(corner, drawn));
  for (const [a, b] of SCENE.edges) {
    const [one, other] = [toPlace(corners[a]), toPlace(corners[b])];
    add(svg, "line", { class: "house", x1: one[0], y1: one[1], x2: other[0], y2: other[1] });
  }
  const second = motionOf({ ...MOTION, tx: drawn * MOTION.tx });
  drawCamera(svg, toPlace, HERE, "one", 0.5 * drawn);
  drawCamera(svg, toPlace, second, "other", 0.5 * drawn);
  const text = withUnit(baseline, unit);
  add(svg, "text", { class: "label", x: toPlace([baseline, 0, 0])[0] + 14, y: 406 }, text);
}

watch(["k", "B", "W"], (values) => {
  const anchor = chosen("anchor"),
    found = scaleNumbers(values, anchor);
  const unit = anchor === "none" ? WORDS.unit : "m";
  byId("B").disabled = anchor !== "baseline";
  byId("W").disabled = anchor !== "width";
  for (const name of ["u1", "u2"]) show(name, found[name], WORDS.unit_px, 4);
  for (const name of ["baseline", "width", "distance"]) show(name, found[name], unit);
  show("meters", found.meters);
  if (anchor === "none") byId("meters").textContent = WORDS.unknown;
  drawPictures(found);
  drawAbove(found, unit);
  told("pictures-told", WORDS.pictures_told, found);
  told("above-told", WORDS.above_told, found);
});
