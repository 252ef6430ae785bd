/* The figures of the page on pipelines: the ratio test, structure from motion by stages, a sliding window, a closed loop. */

/* Matches by the angles to the nearest and the second nearest descriptor. */
function ratioNumbers({ ratio }) {
  const kept = SCENE.nearest.filter(([one, other]) => one < ratio * other),
    right = (list) => list.filter(([, , isRight]) => isRight).length;
  return { kept: kept.length, right: right(kept), wrong: kept.length - right(kept), lost: right(SCENE.nearest) - right(kept) };
}

const line = (svg, text, x, y, kind = "") => add(svg, "text", { class: `label ${kind}`, x, y }, text);

watch(["ratio"], ({ ratio }) => {
  const [svg, width] = fitted("descriptors", 340),
    box = { left: 46, top: 30, right: width - 16, bottom: 240 };
  const { toX, toY } = chartAxes(svg, box, [0.7, 0.6], [WORDS.second_nearest, WORDS.nearest]);
  const end = Math.min(0.7, 0.6 / ratio),
    corner = `L${toX(end)},${toY(ratio * end)} ${end < 0.7 ? `L${box.right},${box.top}` : ""} L${box.right},${box.bottom} Z`;
  add(svg, "path", { class: "sheet one", d: `M${toX(0)},${toY(0)} ${corner}` });
  add(svg, "line", { class: "measure", x1: toX(0), y1: toY(0), x2: toX(end), y2: toY(ratio * end) });
  SCENE.nearest.forEach(([one, other, isRight]) => {
    const kind = `${isRight ? "one" : "other"} ${one < ratio * other ? "" : "hollow"}`;
    add(svg, "circle", { class: kind, cx: toX(other), cy: toY(one), r: 3.4 });
  });
  const { kept, right, wrong, lost } = ratioNumbers({ ratio });
  line(svg, worded(WORDS.kept, { kept, right, wrong }), 12, 302);
  line(svg, worded(WORDS.lost, { lost }), 12, 324);
  told("descriptors-told", WORDS.ratio_told, { kept, wrong, lost }, ["kept", "wrong", "lost"]);
});

/* The model by stages; the image planes show what the cameras observe. */
const IMAGE_AT = 0.9,
  drawModel = space("model", { center: [-0.75, 0.15, -0.5], distance: 12, yaw: 0.5, pitch: 0.5, zoom: innerWidth < 640 ? 1.15 : 1.36 }, innerWidth < 640 ? 300 : 380);
const onImage = (motion, [u, v]) => moved(inverseMotion(motion), scaled(rayOf([u, v]), IMAGE_AT));

function putRays(put, state, stage) {
  const [last, pixels] = [state.cameras.length - 1, state.pixels];
  const from = { 2: [0, 1], 3: [last] }[stage] || [];
  for (const c of from)
    for (const [j, point] of state.points) if (pixels[c][j]) put.line(centerOf(state.cameras[c]), point, "thin");
  if (stage > 1) return;
  const [first, second] = [0, 1].map((c) => state.cameras[c] || SCENE.cameras[c]);
  for (const j of seenInBoth(pixels[0], pixels[1])) {
    const ends = [onImage(first, pixels[0][j]), onImage(second, pixels[1][j])];
    if (stage === 0) put.line(...ends, "thin");
    put.dot(ends[0], "one", 2);
    put.dot(ends[1], "one", 2);
  }
  if (stage === 1) put.line(centerOf(first), centerOf(second), "edge");
}

const setStage = watch(["stage", "s"], ({ stage: number, s }) => {
  const stage = number - 1,
    state = reconstructed(stage, s),
    isNew = (c) => (stage === 1 && c < 2) || ((stage === 3 || stage === 4) && c === 2) || (stage === 5 && c > 2);
  drawModel((put) => {
    for (const [a, b] of SCENE.edges) put.line(SCENE.corners[a], SCENE.corners[b], "thin");
    SCENE.cameras.forEach((camera, c) => {
      const found = state.cameras[c];
      put.camera(found || camera, found ? (isNew(c) ? "other" : "one") : "behind", IMAGE_AT);
      put.label(centerOf(found || camera), String(c + 1), -4, 20);
    });
    putRays(put, state, stage);
    for (const [j, point] of state.points) put.dot(point, state.added.has(j) ? "other" : "one", 3);
  });
  const letter = "ABCDEFG"[stage]; // numbers are those of the steps above
  byId("stage-shown").textContent = letter;
  byId("stage").setAttribute("aria-valuetext", letter);
  byId("what").textContent = WORDS.stages[stage];
  byId("back").disabled = stage === 0;
  byId("next").disabled = stage === LAST_STAGE;
  showCount("used", state.used);
  showCount("registered", state.cameras.length);
  showCount("triangulated", state.points.size);
  show("mean", state.mean, WORDS.unit_px);
  const values = { registered: state.cameras.length, triangulated: state.points.size, mean: state.mean };
  told("model-told", WORDS.model_told, values, ["registered", "triangulated"]);
});
for (const [name, way] of [["back", -1], ["next", 1]])
  byId(name).addEventListener("click", () => {
    setStage({ stage: Math.min(LAST_STAGE + 1, Math.max(1, Number(byId("stage").value) + way)) });
    sayWhenStill(byId(name));
  });

/* Keyframes along a road, and the points beside it: which of them an adjustment of the latest keyframes moves. */
const KEYFRAMES = Array.from({ length: 16 }, (_, k) => [0.8 * k + 0.5, 1.1 * Math.sin(k / 2.3)]),
  SIGHT = 2;
const BESIDE = Array.from({ length: 110 }, (_, j) => {
  const x = 13 * ((j * 0.618034) % 1),
    side = j % 2 ? 1 : -1;
  return [x, 1.1 * Math.sin((x - 0.5) / 0.8 / 2.3) + side * (0.7 + 1.1 * ((j * 0.7548777) % 1))];
});
const isNear = (k, j) => norm(minus(KEYFRAMES[k], BESIDE[j])) < SIGHT;

/* Multiplications of a step by the Schur complement: the blocks of all points, and the factor of the poses. */
const stepCost = (poses, seen) => seen.reduce((sum, n) => sum + 9 + 54 * n + 54 * n * (n + 1), 0) + (6 * poses) ** 3 / 6;

function windowNumbers({ newest, size }) {
  const all = KEYFRAMES.map((_, k) => k).slice(0, newest),
    inside = all.slice(-size);
  const pointsOf = (keyframes) => BESIDE.map((_, j) => j).filter((j) => keyframes.some((k) => isNear(k, j)));
  const points = pointsOf(inside),
    fixed = all.filter((k) => !inside.includes(k) && points.some((j) => isNear(k, j)));
  const cost = (keyframes, moving) => stepCost(keyframes.length, moving.map((j) => keyframes.filter((k) => isNear(k, j)).length));
  const known = pointsOf(all);
  return {
    all,
    inside,
    fixed,
    points,
    known,
    numbers: {
      unknowns: 6 * inside.length + 3 * points.length,
      unknowns_all: 6 * all.length + 3 * known.length,
      work: cost(inside, points),
      work_all: cost(all, known),
    },
  };
}

watch(["newest", "size"], (sliders) => {
  const [svg, width] = fitted("window", (all) => 5.9 * Math.min(50, (all - 24) / 13) + 64),
    unitPx = Math.min(50, (width - 24) / 13),
    left = (width - 13 * unitPx) / 2;
  const toPlace = ([x, y]) => [left + unitPx * x, unitPx * (3.1 - y)];
  const { all, inside, fixed, points, known, numbers } = windowNumbers(sliders);
  known.forEach((j) => {
    const [cx, cy] = toPlace(BESIDE[j]);
    add(svg, "circle", { class: points.includes(j) ? "point" : "faint", cx, cy, r: 3 });
  });
  const d = "M" + all.map((k) => toPlace(KEYFRAMES[k])).join(" L");
  add(svg, "path", { class: "thin", fill: "none", d });
  all.forEach((k) => {
    const [cx, cy] = toPlace(KEYFRAMES[k]),
      kind = inside.includes(k) ? "one" : fixed.includes(k) ? "other" : "behind";
    add(svg, "circle", { class: kind, cx, cy, r: unitPx > 30 ? 8 : 5 });
  });
  const y = 5.9 * unitPx + 24;
  const values = (unknowns, work) => ({ unknowns: grouped(String(unknowns)), work: shownNumber(work) });
  line(svg, worded(WORDS.window, values(numbers.unknowns, numbers.work)), 12, y, "one");
  line(svg, worded(WORDS.all, values(numbers.unknowns_all, numbers.work_all)), 12, y + 22);
  told("window-told", WORDS.window_told, { ...numbers }, ["unknowns", "unknowns_all"]);
});

/* A round trip by odometry, and the same with the constraint that the last keyframe is next to the first. */
const ROUND = SCENE.odometry.length,
  STEP_TURN = (2 * Math.PI) / ROUND,
  RADIUS = 3;
const TRUE_STEP = [RADIUS * Math.sin(STEP_TURN), RADIUS * (1 - Math.cos(STEP_TURN)), STEP_TURN],
  SIGMAS = [0.02, 0.02, degrees(0.5)];
const alongPath = (steps) => steps.reduce((poses, step) => [...poses, composed(poses.at(-1), step)], [[0, -RADIUS, 0]]);

function roundTrip({ drift }) {
  const measured = SCENE.odometry.slice(0, ROUND - 1).map((noise) =>
    composed(TRUE_STEP, [SIGMAS[0] * noise[0], SIGMAS[1] * noise[1], SIGMAS[2] * noise[2] + degrees(drift)]),
  );
  const edges = measured.map((motion, i) => ({ i, j: i + 1, motion, sigmas: SIGMAS }));
  edges.push({ i: ROUND - 1, j: 0, motion: TRUE_STEP, sigmas: SIGMAS });
  return { edges, before: alongPath(measured), truth: alongPath(Array(ROUND - 1).fill(TRUE_STEP)) };
}

function loopNumbers({ drift }) {
  const { edges, before, truth } = roundTrip({ drift }),
    after = optimizedGraph(before, edges).poses;
  const flat = ([x, y]) => [x, y],
    gap = (poses) => norm(minus(flat(composed(poses.at(-1), TRUE_STEP)), flat(poses[0])));
  const off = (poses) =>
    Math.sqrt(poses.reduce((sum, pose, k) => sum + norm(minus(flat(pose), flat(truth[k]))) ** 2, 0) / poses.length);
  const each = (poses) => ({ gap: gap(poses), off: off(poses) });
  return { before, after, truth, numbers: { before: each(before), after: each(after) } };
}

let isClosed = false;

function drawLoop({ drift }) {
  const [svg, width] = fitted("loop", 390),
    size = Math.min(width - 30, 320) / 7.7;
  const { before, after, truth, numbers } = loopNumbers({ drift }),
    toPlace = ([x, y]) => [width / 2 + size * x, 178 - size * y];
  const path = (poses, kind) => add(svg, "path", { class: kind, fill: "none", d: "M" + poses.map(toPlace).join(" L") });
  path([...truth, truth[0]], "thin");
  if (isClosed) path(before, "before");
  const shown = isClosed ? after : before;
  path(shown, "ray one");
  for (const pose of shown) {
    const [cx, cy] = toPlace(pose);
    add(svg, "circle", { class: "one", cx, cy, r: 3 });
  }
  const [[x1, y1], [x2, y2]] = [shown.at(-1), shown[0]].map(toPlace);
  add(svg, "line", { class: isClosed ? "edge" : "dashed", x1, y1, x2, y2 });
  add(svg, "circle", { class: "object", cx: x2, cy: y2, r: 6 });
  const lengths = ({ gap, off }) => ({ gap: withUnit(gap, "m"), off: withUnit(off, "m") });
  line(svg, worded(WORDS.before, lengths(numbers.before)), 12, 356);
  if (isClosed) line(svg, worded(WORDS.after, lengths(numbers.after)), 12, 378, "one");
  byId("close").textContent = isClosed ? WORDS.open : WORDS.close;
  const { gap, off } = isClosed ? numbers.after : numbers.before;
  told("loop-told", WORDS.loop_told, { gap, off });
}

const setLoop = watch(["drift"], drawLoop);
byId("close").addEventListener("click", () => {
  isClosed = !isClosed;
  setLoop({});
  sayWhenStill(byId("close"));
});
document.documentElement.dataset.ready = "yes";
