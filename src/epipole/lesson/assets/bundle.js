/* A small problem settles; what its matrices look like. */
const STEPS = 12;

/* Centers of the cameras after the best similarity onto the true ones (Horn 1987; Umeyama 1991), as `align_points`. */
function aligned(places, truth) {
  const middle = (points) => scaled(points.reduce(plus), 1 / points.length),
    [from, to] = [middle(places), middle(truth)];
  const a = places.map((place) => minus(place, from)),
    b = truth.map((place) => minus(place, to)),
    R = rotationFrom(a, b);
  const turned = a.map((place) => applied(R, place)),
    size = turned.reduce((sum, place, k) => sum + dot(place, b[k]), 0) / turned.reduce((sum, place) => sum + dot(place, place), 0);
  const rule = (place) => plus(to, scaled(applied(R, minus(place, from)), size));
  return { rule, off: places.map((place, k) => norm(minus(rule(place), truth[k]))) };
}

/* Multiplications of a Cholesky factor of the full J^T J, and of V^-1, S and its factor. */
function operations({ U, V, W }) {
  const cameras = 6 * (U.length - 1),
    all = cameras + 3 * V.length;
  return { whole: all ** 3 / 6, reduced: W.reduce((sum, { length }) => sum + pointCost(length), 0) + cameras ** 3 / 6 };
}

/* Multiplications that eliminate one point, which so many cameras see. */
const pointCost = (seen) => 9 + 54 * seen + 54 * seen * (seen + 1);

/* The last adjustment, so that going through its steps takes no time. */
let last = { key: "" };

function adjusted({ visible, s, off }) {
  const key = [visible, s, off].join();
  if (last.key !== key) {
    const problem = bundleOf({ visible, s, off });
    last = { key, problem, steps: adjustmentSteps(problem, STEPS) };
  }
  return last;
}

function bundleNumbers(values) {
  const { problem, steps } = adjusted(values),
    now = steps[values.step],
    equations = normalEquations(problem.observations, now.state);
  const { observations } = problem,
    cameras = SCENE.cameras.length,
    points = SCENE.corners.length;
  const { off, rule } = aligned(now.state.cameras.map((camera) => inverseMotion(camera).t), SCENE.cameras.map((camera) => inverseMotion(camera).t));
  const together = blank(cameras, cameras);
  for (const seen of equations.W) for (const one of seen) for (const other of seen) together[one.c][other.c] = 1;
  const { whole, reduced } = operations(equations);
  const numbers = {
    cost: now.cost,
    rms: Math.sqrt((2 * now.cost) / (2 * observations.length)),
    damping: now.damping,
    cameras_off: Math.sqrt(dot(off, off) / off.length),
    unknowns: 6 * (cameras - 1) + 3 * points,
    residuals: 2 * observations.length,
    filled: (9 * 100) / (6 * cameras + 3 * points),
    filled_s: (together.flat().reduce((a, b) => a + b) * 100) / cameras ** 2,
    whole: whole / 1e3,
    reduced: reduced / 1e3,
  };
  return { problem, steps, now, numbers, together, rule };
}

function drawAbove({ problem, now, rule }) {
  const [svg, width] = fitted("above", 380),
    size = Math.min((width - 30) / 10.5, 36);
  const toPlace = ([x, , z]) => [width / 2 + size * x, 190 - size * z];
  now.state.points.forEach((point, j) => {
    const [x1, y1] = toPlace(SCENE.corners[j]),
      [x2, y2] = toPlace(rule(point));
    add(svg, "line", { class: "thin", x1, y1, x2, y2 });
    add(svg, "circle", { class: "one", cx: x2, cy: y2, r: 2.6 });
  });
  SCENE.cameras.forEach((motion) => drawCamera(svg, toPlace, motion, "true", 0.7));
  now.state.cameras.forEach((camera) => {
    const back = inverseMotion(camera),
      moveTo = (place) => toPlace(rule(place));
    const ends = [-0.56, 0.56].map((x) => moveTo(moved(back, [0.7 * x, 0, 0.7])));
    add(svg, "path", { class: "camera one filled", d: `M${moveTo(back.t)} L${ends[0]} L${ends[1]} Z` });
  });
}

/* Residuals of every step on a logarithmic axis from 0.01 px to 10,000 px: the worst start of the sliders fits. */
const LOG_LEAST = -2,
  LOG_MOST = 4;

function drawFall({ problem, steps }, step) {
  const [svg, width] = fitted("fall", 240),
    box = { left: 52, top: 30, right: width - 16, bottom: 196 };
  const sizes = steps.map(({ cost }) => Math.sqrt(cost / problem.observations.length)),
    powers = Array.from({ length: LOG_MOST - LOG_LEAST + 1 }, (_, k) => LOG_LEAST + k);
  const toX = (k) => box.left + ((box.right - box.left) * k) / STEPS,
    toY = (size) =>
      box.bottom - ((box.bottom - box.top) * (Math.log10(Math.max(size, 1e-2)) - LOG_LEAST)) / (LOG_MOST - LOG_LEAST);
  for (const power of powers) {
    const y = toY(10 ** power);
    add(svg, "line", { class: "grid", x1: box.left, x2: box.right, y1: y, y2: y });
    add(svg, "text", { class: "tick", x: box.left - 7, y: y + 4, "text-anchor": "end" }, grouped(String(10 ** power)));
  }
  steps.forEach((_, k) => add(svg, "text", { class: "tick", x: toX(k), y: box.bottom + 16, "text-anchor": "middle" }, String(k)));
  add(svg, "text", { class: "label", x: box.right, y: box.bottom + 34, "text-anchor": "end" }, WORDS.step);
  add(svg, "text", { class: "label", x: 8, y: 16 }, WORDS.rms);
  add(svg, "path", { class: "ray one", d: "M" + sizes.map((size, k) => `${toX(k)},${toY(size)}`).join(" L") });
  sizes.forEach((size, k) => {
    const kind = steps[k].accepted ? "one" : "behind";
    add(svg, "circle", { class: kind, cx: toX(k), cy: toY(size), r: k === step ? 6 : 3 });
  });
}

/* A pattern in a square of so many unknowns: blocks are (row, column, height, width). */
function pattern(svg, x, side, name, [rows, columns], blocks) {
  add(svg, "text", { class: "label", x, y: 16 }, name);
  const inside = add(svg, "svg", { x, y: 26, width: side, height: side, viewBox: `0 0 ${columns} ${rows}`, preserveAspectRatio: "none" });
  add(inside, "rect", { class: "frame", width: columns, height: rows });
  const d = blocks.map(([row, column, height, width]) => `M${column},${row}h${width}v${height}h${-width}z`).join("");
  add(inside, "path", { class: "block", d });
}

function drawPatterns({ problem, together }) {
  const cameras = SCENE.cameras.length,
    points = SCENE.corners.length,
    all = 6 * cameras + 3 * points;
  const side = (width) => (width - 56) / 3;
  const [svg, width] = fitted("patterns", (all) => side(all) + 40);
  const { observations } = problem;
  const at = (k) => 14 + k * (side(width) + 14);
  const toPoint = (j) => 6 * cameras + 3 * j;
  pattern(
    ...[svg, at(0), side(width), "J", [2 * observations.length, all]],
    observations.flatMap(({ c, j }, k) => [[2 * k, 6 * c, 2, 6], [2 * k, toPoint(j), 2, 3]]),
  );
  const own = [
    ...SCENE.cameras.map((_, c) => [6 * c, 6 * c, 6, 6]),
    ...SCENE.corners.map((_, j) => [toPoint(j), toPoint(j), 3, 3]),
  ];
  const between = observations.flatMap(({ c, j }) => [[6 * c, toPoint(j), 6, 3], [toPoint(j), 6 * c, 3, 6]]);
  pattern(svg, at(1), side(width), "JᵀJ", [all, all], [...own, ...between]);
  const pairs = together.flatMap((row, a) => row.flatMap((v, b) => (v ? [[a, b, 1, 1]] : [])));
  pattern(svg, at(2), side(width), "S = U − W V⁻¹ Wᵀ", [cameras, cameras], pairs);
}

watch(["step", "visible", "s", "off"], (values) => {
  const found = bundleNumbers(values);
  for (const [name, value] of Object.entries(found.numbers)) {
    const unit = { cameras_off: "m", rms: WORDS.unit_px, filled: "%", filled_s: "%", whole: WORDS.thousand, reduced: WORDS.thousand }[name];
    if (name === "unknowns" || name === "residuals") showCount(name, value);
    else show(name, value, unit);
  }
  drawAbove(found);
  drawFall(found, values.step);
  drawPatterns(found);
  told("above-told", WORDS.above_told, found.numbers);
  told("fall-told", WORDS.fall_told, found.numbers);
  told("patterns-told", WORDS.patterns_told, found.numbers);
});
