/* A pixel of the first picture, its line in the second, and what a match beside it leaves over. */
/* As `epipole.geometry.epipolar`. */
const essentialOf = ({ R, t }) => times(skew(t), R);
const fundamentalOf = (E) => times(times(transposed(K_INVERSE), E), K_INVERSE);
const lineOf = (F, [u, v]) => {
  const line = applied(F, [u, v, 1]);
  return scaled(line, 1 / Math.hypot(line[0], line[1]));
};
function sampsonOf(F, [u, v], [u2, v2]) {
  const second = applied(F, [u, v, 1]),
    first = applied(transposed(F), [u2, v2, 1]);
  return Math.abs(dot(second, [u2, v2, 1])) / Math.hypot(second[0], second[1], first[0], first[1]);
}

function epipolarNumbers(values) {
  const motion = motionOf(values),
    E = essentialOf(motion),
    F = fundamentalOf(E),
    pixel = [values.u, values.v];
  const line = lineOf(F, pixel),
    inSecond = moved(motion, scaled(rayOf(pixel), values.Z));
  const there = inSecond[2] > 0 ? project(inSecond) : [NaN, NaN];
  const aside = Number.isFinite(line[0]) ? [line[0], line[1]] : [0, 0];
  const match = plus(there, scaled(aside, values.off));
  return {
    motion,
    E,
    F,
    line,
    match,
    residual: dot([...match, 1], applied(F, [...pixel, 1])),
    distance: Math.abs(dot([...match, 1], line)),
    sampson: sampsonOf(F, pixel, match),
    e2: pixelOf(applied(K, motion.t)),
    e1: pixelOf(applied(K, inverseMotion(motion).t)),
  };
}

const finite = (point) => point.every(Number.isFinite);

/* A line (a, b, c) with a^2 + b^2 = 1, far beyond the picture's rim. */
function drawLine(inside, [a, b, c], kind) {
  if (!Number.isFinite(a)) return;
  const [x, y] = [319.5 - a * (a * 319.5 + b * 239.5 + c), 239.5 - b * (a * 319.5 + b * 239.5 + c)];
  add(inside, "line", {
    class: kind,
    x1: x - 4000 * b,
    y1: y + 4000 * a,
    x2: x + 4000 * b,
    y2: y - 4000 * a,
  });
}

function drawCross(inside, [x, y], kind) {
  if (!Number.isFinite(x) || Math.hypot(x, y) > 1e5) return;
  add(inside, "path", { class: "cross " + kind, d: `M${x - 11},${y} h22 M${x},${y - 11} v22` });
}

function drawPictures({ u, v }, found) {
  const [first, second] = twoPictures("pictures", [WORDS.first, WORDS.second]);
  first.id = "first";
  drawHouse(first, SCENE.corners, HERE);
  drawHouse(second, SCENE.corners, found.motion);
  for (const other of [80, 240, 400].flatMap((y) => [
    [120, y],
    [520, y],
  ])) {
    const line = lineOf(found.F, other);
    drawLine(second, line, "thin");
    const match = project(moved(found.motion, scaled(rayOf(other), 5)));
    drawLine(first, lineOf(transposed(found.F), match), "thin");
  }
  drawLine(second, found.line, "ray one");
  drawCross(first, found.e1, "end");
  drawCross(second, found.e2, "end");
  add(first, "circle", { class: "one", cx: u, cy: v, r: 9 });
  if (finite(found.match))
    add(second, "circle", { class: "other", cx: found.match[0], cy: found.match[1], r: 9 });
}

const set = watch(["u", "v", "Z", "off", "tx", "ty", "tz", "yaw", "pitch", "roll"], (values) => {
  const found = epipolarNumbers(values);
  const shown = { x2: found.match[0], y2: found.match[1], distance: found.distance, sampson: found.sampson };
  const ends = { e2u: found.e2[0], e2v: found.e2[1], e1u: found.e1[0], e1v: found.e1[1] };
  for (const [name, value] of Object.entries({ ...shown, ...ends }))
    show(name, value, WORDS.unit_px, name in ends || name === "x2" || name === "y2" ? 4 : 3);
  // At infinity an epipole has a direction and no place.
  const awayIn = { e2: applied(K, found.motion.t), e1: applied(K, inverseMotion(found.motion).t) };
  for (const [name, [x, y, w]] of Object.entries(awayIn))
    if (w === 0 && norm([x, y]) > 0) {
      byId(name + "u").textContent = WORDS.infinite;
      byId(name + "v").textContent = `${WORDS.direction} (${scaled([x, y], 1 / norm([x, y]))
        .map((v) => shownNumber(v, 2))
        .join(", ")})`;
    }
  show("residual", found.residual);
  for (const [name, A] of Object.entries({ E: found.E, F: found.F, K })) matrixTable("matrix-" + name, A, name === "K" ? 4 : 3);
  drawPictures(values, found);
  told("pictures-told", WORDS.pictures_told, { ...values, ...shown });
});

/* A mouse need only move over the picture; a finger is followed to the side, and scrolls the page up and down. */
function follow(event) {
  const inside = byId("first"),
    at = new DOMPoint(event.clientX, event.clientY).matrixTransform(inside.getScreenCTM().inverse());
  if (at.x >= 0 && at.x <= 639 && at.y >= 0 && at.y <= 479) set({ u: at.x, v: at.y });
}
byId("pictures").addEventListener("pointermove", follow);
byId("pictures").addEventListener("pointerdown", (event) => {
  if (event.pointerType === "touch") byId("pictures").setPointerCapture(event.pointerId);
  follow(event);
});
byId("pictures").style.touchAction = "pan-y";
