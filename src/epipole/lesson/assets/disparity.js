/* Disparity and depth: f B / Z there, f B / d back, and what an error of the match does to it. */

/* As `epipole.geometry.disparity`: depth_to_disparity, disparity_to_depth, depth_error. */
const disparityOf = (Z, f, B) => (f * B) / Z;
const depthOf = (d, f, B) => (d >= 0 ? (f * B) / Math.abs(d) : Infinity);
const depthErrorOf = (Z, f, B, e) => ((Z * Z) / (f * B)) * Math.abs(e);

function stereoNumbers({ Z, X, B, f, e }) {
  const d = disparityOf(Z, f, B);
  return {
    xl: (f * X) / Z,
    xr: (f * (X - B)) / Z,
    d,
    back: depthOf(d, f, B),
    dz: depthErrorOf(Z, f, B, e),
    nearest: depthOf(d + e, f, B),
    farthest: depthOf(d - e, f, B),
  };
}

/* From above: as far ahead as the object asks for; a meter aside is drawn longer than one ahead. */
const FLOOR = {
  bottom: 296,
  top: 30,
  middle: 196,
  aside: 440,
  reaches: [5, 10, 20, 42],
  reach: 5,
  held: false,
};
const aheadOf = (Z) => FLOOR.bottom - ((FLOOR.bottom - FLOOR.top) * Z) / FLOOR.reach;
const asideOf = (X) => FLOOR.middle + FLOOR.aside * X;

function drawAbove({ Z, X, B }, found) {
  if (!FLOOR.held) FLOOR.reach = FLOOR.reaches.find((reach) => reach >= Math.min(42, 1.15 * Z));
  const svg = clear("above");
  for (const z of marks(FLOOR.reach, 4).slice(1)) {
    add(svg, "line", { class: "grid", x1: 14, x2: 426, y1: aheadOf(z), y2: aheadOf(z) });
    add(svg, "text", { class: "tick", x: 424, y: aheadOf(z) - 4, "text-anchor": "end" }, `${z} m`);
  }
  const from = [asideOf(0), asideOf(B)],
    to = [asideOf(X), aheadOf(Z)];
  const far = aheadOf(Math.min(found.farthest, 1.1 * FLOOR.reach)),
    near = aheadOf(found.nearest);
  add(svg, "rect", { class: "band", x: to[0] - 22, width: 44, y: far, height: Math.max(1, near - far) });
  for (const y of [far, near])
    add(svg, "line", { class: "error-end", x1: to[0] - 22, x2: to[0] + 22, y1: y, y2: y });
  from.forEach((x, k) => {
    add(svg, "line", { class: "ray " + ["one", "other"][k], x1: x, y1: FLOOR.bottom, x2: to[0], y2: to[1] });
  });
  add(svg, "line", { class: "measure", x1: from[0], x2: from[1], y1: FLOOR.bottom, y2: FLOOR.bottom });
  from.forEach((x, k) => add(svg, "circle", { class: ["one", "other"][k], cx: x, cy: FLOOR.bottom, r: 6 }));
  add(
    svg,
    "text",
    { class: "label", x: from[0] - 12, y: FLOOR.bottom + 5, "text-anchor": "end" },
    WORDS.left,
  );
  const aside =
    from[1] > 320
      ? { x: 434, y: FLOOR.bottom + 24, "text-anchor": "end" }
      : { x: from[1] + 12, y: FLOOR.bottom + 5 };
  add(svg, "text", { class: "label", ...aside }, WORDS.right);
  add(svg, "circle", { class: "object", cx: to[0], cy: to[1], r: 6 });
  add(svg, "circle", { class: "grip handle", cx: to[0], cy: to[1], r: 28 });
}

/* Both pictures one above the other, so that the difference can be seen; both are as wide as 1000 px. */
const PER_PX = 0.408;

function drawPictures(found) {
  const svg = clear("pictures"),
    toX = (x) => 220 + PER_PX * x;
  [WORDS.left_picture, WORDS.right_picture].forEach((name, k) => {
    const top = 28 + 118 * k;
    add(svg, "rect", { class: "frame", x: 16, y: top, width: 408, height: 84 });
    add(svg, "line", { class: "mark", x1: 220, x2: 220, y1: top, y2: top + 84 });
    add(svg, "text", { class: "label", x: 16, y: top - 8 }, name);
    const x = [found.xl, found.xr][k],
      kind = ["one", "other"][k];
    if (Math.abs(x) <= 500)
      add(svg, "circle", { class: kind, cx: toX(x), cy: top + 42, r: 7, stroke: "none" });
    else {
      const side = Math.sign(x),
        tip = 220 + 200 * side;
      add(svg, "path", {
        class: kind + " filled",
        d: `M${tip},${top + 42} l${-14 * side},-8 v16 z`,
        stroke: "none",
      });
      const to = { x: tip - 20 * side, y: top + 47, "text-anchor": side > 0 ? "end" : "start" };
      add(svg, "text", { class: "label", ...to }, WORDS.outside);
    }
  });
  const [a, b] = [found.xr, found.xl].map((x) => Math.min(424, Math.max(16, toX(x))));
  add(svg, "line", { class: "grid", x1: b, x2: b, y1: 77, y2: 270 });
  add(svg, "line", { class: "grid", x1: a, x2: a, y1: 195, y2: 270 });
  add(svg, "path", { class: "measure", d: `M${a},262 v16 m0,-8 H${b} m0,-8 v16` });
  const text = `d = ${shownNumber(found.d, 3)} ${WORDS.unit_px}`;
  add(svg, "text", { x: Math.min(380, Math.max(60, (a + b) / 2)), y: 302, "text-anchor": "middle" }, text);
  if (PER_PX * found.d < 12) drawMagnified(svg, found, (a + b) / 2 < 220 ? 290 : 16);
}

/* A disparity that is too small to be seen, some round number of times as large. */
function drawMagnified(svg, { d }, left) {
  const times = [500, 200, 100, 50, 20, 10, 5].find((k) => k * PER_PX * d <= 84) || 5,
    half = (times * PER_PX * d) / 2;
  add(svg, "rect", { class: "frame", x: left, y: 240, width: 134, height: 56 });
  [half, -half].forEach((x, k) => {
    add(svg, "circle", { class: ["one", "other"][k], cx: left + 67 + x, cy: 256, r: 7, stroke: "none" });
  });
  add(svg, "path", { class: "measure", d: `M${left + 67 - half},272 v8 m0,-4 h${2 * half} m0,-4 v8` });
  add(svg, "text", { class: "tick", x: left + 67, y: 312, "text-anchor": "middle" }, `${times} \u00d7`);
}

/* The chart's scale is fixed so that curves can be compared: meters of depth and of error. */
const CURVE = { depth: 40, error: 20 };
const WORKED = { f: 800, B: 0.12, e: 1 };

/* Error against depth, up to the top of the chart. */
function errorPath({ f, B, e }, toX, toY) {
  const end = Math.min(CURVE.depth, Math.sqrt((CURVE.error * f * B) / e));
  const at = (z) => `${toX(z).toFixed(2)},${toY(depthErrorOf(z, f, B, e)).toFixed(2)}`;
  return "M" + Array.from({ length: 81 }, (_, k) => at((end * k) / 80)).join(" L");
}

function drawCurve(values, found) {
  const [svg, width] = fitted("curve", 260),
    box = { left: 58, top: 28, right: width - 16, bottom: 212 };
  const { toX, toY } = chartAxes(
    svg,
    box,
    [CURVE.depth, CURVE.error],
    [WORDS.depth_axis, WORDS.error_axis],
  );
  const [x, y] = [toX(values.Z), toY(Math.min(found.dz, CURVE.error))];
  add(svg, "path", { class: "before", d: errorPath(WORKED, toX, toY) });
  add(svg, "path", { class: "series accent", d: errorPath(values, toX, toY) });
  add(svg, "path", { class: "mark", d: `M${x},${box.bottom} V${y} H${box.left}` });
  if (found.dz <= CURVE.error) add(svg, "circle", { class: "object", cx: x, cy: y, r: 7 });
  else {
    const side = x > width / 2 ? { x: x - 12, "text-anchor": "end" } : { x: x + 12 };
    add(svg, "path", { class: "object", d: `M${x},${y - 8} l-8,14 h16 z` });
    add(svg, "text", { class: "label", y: y + 18, ...side }, withUnit(found.dz, "m"));
  }
}

const set = watch(["Z", "X", "B", "f", "e"], (values) => {
  const found = stereoNumbers(values);
  for (const name of ["xl", "xr", "d"]) show(name, found[name], WORDS.unit_px, 3);
  for (const name of ["back", "dz", "nearest", "farthest"]) show(name, found[name], "m");
  drawAbove(values, found);
  drawPictures(found);
  drawCurve(values, found);
  told("above-told", WORDS.above_told, values);
  told("pictures-told", WORDS.pictures_told, found);
  told("curve-told", WORDS.curve_told, { ...values, ...found });
});

drag(
  byId("above"),
  (x, y) => {
    FLOOR.held = true; // else the picture would grow away under the hand
    const Z = (FLOOR.reach * (FLOOR.bottom - y)) / (FLOOR.bottom - FLOOR.top);
    set({
      Z: Math.min(40, Math.max(0.5, Z)),
      X: Math.min(0.4, Math.max(-0.4, (x - FLOOR.middle) / FLOOR.aside)),
    });
  },
  () => {
    FLOOR.held = false;
    set({});
  },
);
