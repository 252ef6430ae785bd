/* The small figures of the page on bundle adjustment: residuals in images, blocks of matrices, costs of a step, the pull of an
   outlier. */

/* Three cameras beside each other, the points that all of them see, and an estimate of which a camera and a point are displaced. */
const SHOWN = [9, 0, 1],
  EXACT = bundleOf({ visible: 100, s: 0.5, off: 0 }),
  COMMON = SCENE.corners
    .map((_, j) => j)
    .filter((j) => SHOWN.every((c) => EXACT.observations.some((seen) => seen.c === c && seen.j === j))),
  SHIFTED = COMMON[Math.floor(COMMON.length / 2)];

function insetNumbers({ by_camera, by_point }) {
  const state = {
    cameras: SCENE.cameras.map((camera, c) => (c === SHOWN[1] ? shifted(camera, [by_camera, 0, 0, 0, 0, 0]) : camera)),
    points: SCENE.corners.map((point, j) => (j === SHIFTED ? plus(point, [0, by_point, 0]) : point)),
  };
  const observations = EXACT.observations.filter(({ c, j }) => SHOWN.includes(c) && COMMON.includes(j));
  const images = SHOWN.map((camera) =>
    observations
      .filter(({ c }) => c === camera)
      .map(({ c, j, pixel }) => ({ j, pixel, guess: project(moved(state.cameras[c], state.points[j])) })),
  );
  const rms = images.map((seen) =>
    Math.sqrt(seen.reduce((sum, { pixel, guess }) => sum + norm(minus(pixel, guess)) ** 2, 0) / (2 * seen.length)),
  );
  return { images, rms, cost: costOf(observations, state) };
}

watch(["by_camera", "by_point"], (values) => {
  const { images, rms, cost } = insetNumbers(values),
    side = (all) => (all - 40) / 3,
    [svg, width] = fitted("insets", (all) => side(all) + 62);
  images.forEach((seen, k) => {
    const x = 10 + k * (side(width) + 10),
      wide = side(width);
    add(svg, "text", { class: "label", x, y: 18 }, `${WORDS.image} ${k + 1}`);
    // The middle of the image, where the points are.
    const inside = add(svg, "svg", { x, y: 26, width: wide, height: wide, viewBox: "110 30 420 420" });
    add(inside, "rect", { class: "frame", x: 110, y: 30, width: 420, height: 420 });
    const size = 420 / wide;
    seen.forEach(({ j, pixel, guess }) => {
      add(inside, "line", {
        class: "residual",
        x1: guess[0],
        y1: guess[1],
        x2: pixel[0],
        y2: pixel[1],
        "stroke-width": 2 * size,
      });
      const kind = j === SHIFTED ? "point" : "one";
      add(inside, "circle", { class: kind, cx: pixel[0], cy: pixel[1], r: (j === SHIFTED ? 5 : 3) * size });
    });
    add(svg, "text", { class: "label", x, y: wide + 46 }, withUnit(rms[k], WORDS.unit_px));
  });
  show("small_cost", cost);
  const [one, two, three] = rms;
  told("insets-told", WORDS.insets_told, { one, two, three });
});

/* Which cameras see point j: k neighbors in the row of cameras. */
const seenFrom = (j, c, k, p) => {
  const first = p > 1 ? Math.round(((c - k) * j) / (p - 1)) : 0;
  return Array.from({ length: k }, (_, i) => first + i);
};

/* Blocks (row, column, height, width) of J and of J^T J, and how much of each is not zero. */
function arrowNumbers({ c, p, k }) {
  const seen = Math.min(k, c),
    all = 6 * c + 3 * p,
    rows = 2 * p * seen;
  const pairs = Array.from({ length: p }, (_, j) => seenFrom(j, c, seen, p).map((camera) => [camera, j])).flat();
  const toPoint = (j) => 6 * c + 3 * j;
  const J = { one: [], point: [] },
    H = { one: [], other: [], point: [] };
  pairs.forEach(([camera, j], row) => {
    J.one.push([2 * row, 6 * camera, 2, 6]);
    J.point.push([2 * row, toPoint(j), 2, 3]);
    H.other.push([6 * camera, toPoint(j), 6, 3], [toPoint(j), 6 * camera, 3, 6]);
  });
  for (let camera = 0; camera < c; camera++) H.one.push([6 * camera, 6 * camera, 6, 6]);
  for (let j = 0; j < p; j++) H.point.push([toPoint(j), toPoint(j), 3, 3]);
  const area = (blocks) => Object.values(blocks).flat().reduce((sum, [, , height, width]) => sum + height * width, 0);
  return { all, rows, J, H, filled: { J: (100 * area(J)) / (rows * all), H: (100 * area(H)) / all ** 2 } };
}

function blocksIn(svg, [x, y, width, height], [rows, columns], blocks) {
  const inside = add(svg, "svg", { x, y, width, height, viewBox: `0 0 ${columns} ${rows}`, preserveAspectRatio: "none" });
  add(inside, "rect", { class: "frame", width: columns, height: rows });
  for (const [kind, list] of Object.entries(blocks)) {
    const d = list.map(([row, column, high, wide]) => `M${column},${row}h${wide}v${high}h${-wide}z`).join("");
    add(inside, "path", { class: `filled-${kind}`, d });
  }
}

watch(["c", "p", "k"], (values) => {
  const { all, rows, J, H, filled } = arrowNumbers(values),
    side = (width) => Math.min(270, (width - 44) / 2),
    [svg, width] = fitted("arrow", (whole) => side(whole) + 66);
  const wide = side(width),
    left = (width - 2 * wide - 20) / 2;
  const places = [left, left + wide + 20];
  blocksIn(svg, [places[0], 28, wide, wide], [rows, all], J);
  blocksIn(svg, [places[1], 28, wide, wide], [all, all], H);
  [["J", rows, filled.J], ["JᵀJ", all, filled.H]].forEach(([name, high, part], k) => {
    add(svg, "text", { class: "label strong", x: places[k], y: 19 }, `${name}: ${high} × ${all}`);
    add(svg, "text", { class: "label", x: places[k], y: wide + 50 }, `${withUnit(part, "%")} ${WORDS.nonzero}`);
  });
  told("arrow-told", WORDS.arrow_told, filled);
});

/* Multiplications of one step for so many photographs, each of which adds so many points that TRACK photographs see. */
const TRACK = 5;

function workNumbers({ many, each }) {
  const points = many * each,
    all = 6 * many + 3 * points;
  const reduced = points * pointCost(TRACK) + (6 * many) ** 3 / 6;
  return { points, unknowns: all, dense: all ** 3 / 6, schur: reduced };
}

watch(["many", "each"], (values) => {
  const [svg, width] = fitted("work", 320),
    box = { left: 62, top: 40, right: width - 26, bottom: 216 },
    [least, most] = [3, 21];
  const toX = (many) => box.left + ((box.right - box.left) * (many - 10)) / 1990,
    toY = (value) => box.bottom - ((box.bottom - box.top) * (Math.log10(value) - least)) / (most - least);
  for (let power = least; power <= most; power += 3) {
    const y = toY(10 ** power);
    add(svg, "line", { class: "grid", x1: box.left, x2: box.right, y1: y, y2: y });
    add(svg, "text", { class: "tick", x: box.left - 7, y: y + 4, "text-anchor": "end" }, shownNumber(10 ** power, 1).replace("1 × ", ""));
  }
  for (const many of [500, 1000, 1500, 2000])
    add(svg, "text", { class: "tick", x: toX(many), y: box.bottom + 16, "text-anchor": "middle" }, grouped(String(many)));
  add(svg, "text", { class: "label", x: box.right, y: box.bottom + 34, "text-anchor": "end" }, WORDS.photographs);
  add(svg, "text", { class: "label", x: 8, y: 18 }, WORDS.multiplications);
  const now = workNumbers(values);
  [["dense", "other"], ["schur", "one"]].forEach(([name, kind]) => {
    const d = Array.from({ length: 200 }, (_, k) => {
      const many = 10 + 10 * k;
      return `${toX(many).toFixed(1)},${toY(workNumbers({ many, each: values.each })[name]).toFixed(1)}`;
    }).join(" L");
    add(svg, "path", { class: `ray ${kind}`, d: `M${d}` });
    add(svg, "circle", { class: kind, cx: toX(values.many), cy: toY(now[name]), r: 6 });
  });
  const line = (text, y, kind) => add(svg, "text", { class: `label ${kind}`, x: 8, y }, text);
  const size = { c: grouped(String(values.many)), p: grouped(String(now.points)) };
  line(worded(WORDS.size_of, size), 270, "");
  line(worded(WORDS.dense, { work: shownNumber(now.dense) }), 290, "other");
  line(worded(WORDS.with_schur, { work: shownNumber(now.schur), ratio: shownNumber(now.dense / now.schur) }), 310, "one");
  told("work-told", WORDS.work_told, now);
});

/* The derivative of half the loss by the residual; `epipole.optim.evaluate_loss` is the loss of its square. */
const PULLS = { squared: (r) => r, cauchy: (r, s) => r / (1 + (r / s) ** 2) };

watch(["r", "scale"], ({ r, scale }) => {
  const [svg, width] = fitted("pull", 290),
    box = { left: 46, top: 30, right: width - 16, bottom: 228 },
    most = 10;
  const { toX, toY } = chartAxes(svg, box, [20, most], [WORDS.residual, WORDS.pull]);
  Object.entries(PULLS).forEach(([name, pull], k) => {
    const kind = ["other", "one"][k],
      at = (v) => `${toX(v).toFixed(1)},${toY(pull(v, scale)).toFixed(1)}`,
      last = name === "squared" ? most : 20;
    add(svg, "path", { class: `ray ${kind}`, d: "M" + Array.from({ length: 161 }, (_, i) => at((last * i) / 160)).join(" L") });
    const value = pull(r, scale),
      isShown = value <= most;
    if (isShown) add(svg, "circle", { class: kind, cx: toX(r), cy: toY(value), r: 6 });
    const words = worded(WORDS[name], { pull: shownNumber(value) });
    add(svg, "text", { class: `label ${kind}`, x: 12 + k * Math.min(200, width / 2), y: 276 }, words);
  });
  add(svg, "line", { class: "dashed", x1: toX(r), x2: toX(r), y1: box.top, y2: box.bottom });
  told("pull-told", WORDS.pull_told, { squared: PULLS.squared(r), cauchy: PULLS.cauchy(r, scale) });
});
document.documentElement.dataset.ready = "yes";
