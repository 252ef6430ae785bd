/* The small figures of the page on PnP: a guessed pose, four poses of three points, samples of RANSAC, SLAM in two steps. */

/* The observed pixels of a known house, and what a guessed camera would see. */
const KNOWN = SCENE.house,
  TRUE_POSE = motionOf({ tx: 0.4, tz: 0.3, yaw: -6 }),
  OBSERVED = KNOWN.corners.map((corner) => project(moved(TRUE_POSE, corner)));
const drawGuess = space("pose3d", { center: [0.3, -0.1, 2.5], distance: 12, yaw: -0.85, pitch: 0.38, zoom: 1.65 }, 330);

watch(["gx", "gz", "gyaw"], ({ gx, gz, gyaw }) => {
  const guess = motionOf({ tx: gx, tz: gz, yaw: gyaw }),
    back = inverseMotion(guess),
    truth = inverseMotion(TRUE_POSE).t;
  drawGuess((put) => {
    putHouse(put, KNOWN.corners, KNOWN.edges);
    put.camera(TRUE_POSE, "gray", 0.9);
    put.camera(guess, "other", 0.9);
    for (const k of [0, 1, 2, 3, 8]) {
      const far = norm(minus(KNOWN.corners[k], back.t));
      put.line(back.t, moved(back, scaled(unit(rayOf(OBSERVED[k])), far)), "ray other");
    }
    for (const corner of KNOWN.corners) put.dot(corner, "one", 4);
  });
  const [inside] = insets("pose-image", [WORDS.image]);
  KNOWN.corners.forEach((corner, k) => {
    const seen = project(moved(guess, corner)),
      [x1, y1] = OBSERVED[k];
    add(inside, "line", { class: "edge", x1, y1, x2: seen[0], y2: seen[1] });
    insetMark(inside, OBSERVED[k], "cross truth", 5);
    insetMark(inside, seen, "other", 3.5);
  });
  const off = cameraResiduals(guess, KNOWN.corners, OBSERVED),
    numbers = {
      rms: Math.sqrt(dot(off, off) / off.length),
      position: norm(minus(back.t, truth)),
      rotation: angleOf(times(guess.R, transposed(TRUE_POSE.R))),
    };
  show("pose-rms", numbers.rms, WORDS.unit_px);
  show("pose-position", numbers.position, "m");
  show("pose-rotation", numbers.rotation, "°");
  told("pose3d-told", WORDS.pose_told, numbers);
});

/* Three landmarks with equal distances from each other, and a fourth one that decides. */
const TRIANGLE = [0, 120, 240].map((angle) => [2 * Math.cos(degrees(angle)), 2 * Math.sin(degrees(angle)), 0]),
  FOURTH = [0.2, -0.5, -0.9];
const drawPoses = space("poses3d", { center: [0.6, 0.3, -1.2], distance: 15, yaw: 0.75, pitch: 0.36, zoom: 1.28 }, 380);

function posesNumbers({ cx, cz }) {
  const truth = motionOf({ tx: cx, ty: 0.15, tz: -cz }),
    rays = TRIANGLE.map((point) => moved(truth, point)),
    observed = project(moved(truth, FOURTH));
  const poses = posesOfThree(rays, TRIANGLE).map((pose) => ({
    pose,
    pixel: project(moved(pose, FOURTH)),
    isAhead: moved(pose, FOURTH)[2] > 0,
  }));
  const off = (one) => (one.isAhead ? norm(minus(one.pixel, observed)) : Infinity);
  poses.sort((a, b) => off(a) - off(b));
  return { rays, observed, poses, errors: poses.map(off) };
}

watch(["cx", "cz"], (values) => {
  const { rays, observed, poses, errors } = posesNumbers(values),
    kindOf = (k) => (k === 0 ? "one" : "other");
  drawPoses((put) => {
    TRIANGLE.forEach((point, k) => put.line(point, TRIANGLE[(k + 1) % 3], "house strong"));
    poses.forEach(({ pose }, k) => {
      put.camera(pose, kindOf(k), 0.7);
      for (const point of TRIANGLE) put.line(inverseMotion(pose).t, point, `ray ${kindOf(k)}`);
      put.label(inverseMotion(pose).t, "ABCD"[k], 10, 16);
    });
    for (const point of TRIANGLE) put.dot(point, "object", 6);
    put.dot(FOURTH, "point", 6);
  });
  const [inside] = insets("poses-image", [WORDS.image]);
  enlarge(inside, [319.5, 239.5], 1500);
  for (const ray of rays) insetMark(inside, project(ray), "object", 5);
  poses.forEach(({ pixel, isAhead }, k) => {
    if (!isAhead) return;
    insetMark(inside, pixel, kindOf(k), 4.5);
    const size = Number(inside.dataset.unit),
      [x, y] = plus(pixel, [8 * size, -6 * size]);
    add(inside, "text", { class: `label ${kindOf(k)}`, x, y, style: `font-size: ${12 * size}px` }, "ABCD"[k]);
  });
  insetMark(inside, observed, "cross truth", 8);
  showCount("poses-count", poses.length);
  show("poses-best", errors[0], WORDS.unit_px);
  show("poses-next", errors.length > 1 ? errors[1] : NaN, WORDS.unit_px);
  told("poses3d-told", WORDS.poses_told, { count: poses.length, best: errors[0], next: errors[1] }, ["count"]);
});

/* Samples until one has no outlier, with this confidence: as the library's RANSAC. */
const samplesNeeded = (outliers, size, confidence) => Math.log(1 - confidence) / Math.log(1 - (1 - outliers) ** size);
const SAMPLES = { outliers: 75, most: 480 };

watch(["po", "pc"], ({ po, pc }) => {
  const [svg, width] = fitted("samples", 270),
    box = { left: 48, top: 28, right: width - 16, bottom: 222 };
  const { toX, toY } = chartAxes(svg, box, [SAMPLES.outliers, SAMPLES.most], [WORDS.outliers_axis, WORDS.samples_axis]);
  const curve = (size) => {
    const all = Array.from({ length: 150 }, (_, k) => 0.5 * (k + 1)).map((x) => [x, samplesNeeded(x / 100, size, pc / 100)]);
    return "M" + all.filter(([, y]) => y <= SAMPLES.most).map(([x, y]) => `${toX(x).toFixed(1)},${toY(y).toFixed(1)}`).join(" L");
  };
  const [three, six] = [3, 6].map((size) => samplesNeeded(po / 100, size, pc / 100)),
    [x, y] = [toX(po), toY(three)];
  add(svg, "path", { class: "before", d: curve(6) });
  add(svg, "path", { class: "series accent", d: curve(3) });
  add(svg, "path", { class: "mark", d: `M${x},${box.bottom} V${y} H${box.left}` });
  add(svg, "circle", { class: "object", cx: x, cy: y, r: 7 });
  showCount("samples-three", Math.ceil(three));
  showCount("samples-six", Math.ceil(six));
  told("samples-told", WORDS.samples_told, { po, three: Math.ceil(three), six: Math.ceil(six) }, ["three", "six"]);
});

/* SLAM in steps: a camera from known points, then points from known cameras. */
const ALTERNATING = { step: 0, last: 7 };
const drawSteps = space("steps3d", { center: [2.9, 0, 7], distance: 26, yaw: -0.3, pitch: 0.75, zoom: 1.72 }, 380);

function raysOfStep(state, pixels) {
  const last = state.cameras.length - 1;
  if (state.placed) return [...state.points.keys()].filter((j) => pixels[last][j]).map((j) => [last, j]);
  return [...state.added].flatMap((j) => [[pixels.findIndex((seen) => seen[j]), j], [last, j]]);
}

function showStep() {
  const { step } = ALTERNATING,
    state = wayNumbers({ step, s: 0.5, most: 90 }),
    pixels = TRUE_PATH.map((_, c) => seenBy(c, 0.5)),
    last = state.cameras.length - 1;
  drawSteps((put) => {
    SCENE.corners.forEach((corner, j) => !state.points.has(j) && put.dot(corner, "behind", 3));
    for (const [c, j] of raysOfStep(state, pixels))
      put.line(centerOf(state.cameras[c]), state.points.get(j), `thin ${state.placed ? "one" : "other"}`);
    for (const [j, point] of state.points) put.dot(point, state.added.has(j) ? "other" : "one", 4);
    state.cameras.forEach((camera, c) => put.camera(camera, state.placed && c === last ? "other" : "one", 1.1));
  });
  showCount("steps-cameras", state.cameras.length);
  showCount("steps-points", state.points.size);
  byId("steps-what").textContent = step === 0 ? WORDS.begin : state.placed ? WORDS.pnp : WORDS.triangulation;
  told("steps3d-told", WORDS.above_told, state.numbers, COUNTS);
}

byId("next-step").addEventListener("click", (event) => {
  ALTERNATING.step = ALTERNATING.step === ALTERNATING.last ? 0 : ALTERNATING.step + 1;
  showStep();
  sayWhenStill(event.currentTarget);
});
showStep();
document.documentElement.dataset.ready = "yes";
