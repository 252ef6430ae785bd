/* A camera on its way: placed by known points, then points by known cameras, and so on. */
const LEAST_ANGLE = degrees(1.5),
  GIVEN = 2;
const TRUE_PATH = SCENE.path.map(([tx, ty, tz, yaw]) => motionOf({ tx, ty, tz, yaw }));

/* What camera c sees of the landmarks, with noise; null where it does not. */
function seenBy(c, s) {
  return SCENE.corners.map((place, j) => {
    const there = moved(TRUE_PATH[c], place);
    if (there[2] < 0.5) return null;
    const pixel = plus(project(there), scaled(SCENE.noise[c][j], s));
    return pixel[0] >= 0 && pixel[0] <= 639 && pixel[1] >= 0 && pixel[1] <= 479 ? pixel : null;
  });
}

const centerOf = (motion) => inverseMotion(motion).t;
const median = (values) => {
  const sorted = values.slice().sort((a, b) => a - b),
    half = sorted.length >> 1;
  return sorted.length % 2 ? sorted[half] : (sorted[half - 1] + sorted[half]) / 2;
};

/* Place the next camera: it starts where the last one stands, and uses `most` of the known points, spread over all. */
function placeCamera(state, pixels, most) {
  const all = [...state.points.keys()].filter((j) => pixels[state.cameras.length][j]),
    count = Math.min(most, all.length),
    known = Array.from({ length: count }, (_, k) => all[Math.floor((k * all.length) / count)]);
  const start = state.cameras.at(-1);
  state.cameras.push(
    refinedCamera(
      known.map((j) => state.points.get(j)),
      known.map((j) => pixels[state.cameras.length][j]),
      start,
    ),
  );
  return known.length;
}

/* Points that the newest camera and an earlier one see under an angle: the earliest one takes part. */
function addPoints(state, pixels) {
  const last = state.cameras.length - 1;
  let used = 0;
  SCENE.corners.forEach((_, j) => {
    if (state.points.has(j) || !pixels[last][j]) return;
    const first = pixels.slice(0, last).findIndex((seen) => seen[j]);
    if (first < 0) return;
    const motions = [state.cameras[first], state.cameras[last]],
      both = [pixels[first][j], pixels[last][j]];
    const between = { R: times(motions[1].R, transposed(motions[0].R)), t: [0, 0, 0] };
    between.t = minus(motions[1].t, applied(between.R, motions[0].t));
    const { point } = triangulated(between, rayOf(both[0]), rayOf(both[1]));
    const found = refinedPoint(motions, both, moved(inverseMotion(motions[0]), point)),
      [a, b] = motions.map((motion) => minus(found, centerOf(motion)));
    const isAhead = motions.every((motion) => moved(motion, found)[2] > 0);
    if (!isAhead || Math.atan2(norm(cross(a, b)), dot(a, b)) < LEAST_ANGLE) return;
    state.points.set(j, found);
    state.added.add(j);
    used += 2;
  });
  return used;
}

function wayNumbers({ step, s, most }) {
  const pixels = TRUE_PATH.map((_, c) => seenBy(c, s));
  const state = { cameras: TRUE_PATH.slice(0, GIVEN), points: new Map(), added: new Set(), seen: 0 };
  for (let k = 0; k <= step; k++) {
    state.added = new Set();
    state.placed = k % 2 === 1;
    state.seen = state.placed ? placeCamera(state, pixels, most) : addPoints(state, pixels);
  }
  const last = state.cameras.length - 1,
    truth = TRUE_PATH[last],
    found = state.cameras[last];
  state.numbers = {
    seen: state.seen,
    cameras: state.cameras.length,
    points: state.points.size,
    camera_off: norm(minus(centerOf(found), centerOf(truth))),
    turn_off: angleOf(times(found.R, transposed(truth.R))),
    points_off: median([...state.points].map(([j, point]) => norm(minus(point, SCENE.corners[j])))),
  };
  return state;
}

function drawAbove(state) {
  const [svg, width] = fitted("above", 420),
    size = Math.min((width - 40) / 13, 22.5); // the farthest estimate is 16.4 m ahead
  const toPlace = ([x, , z]) => [width / 2 + size * (x - 3), 396 - size * (z + 0.4)];
  SCENE.corners.forEach((place, j) => {
    const [x, y] = toPlace(place),
      known = state.points.get(j);
    add(svg, "circle", { class: "behind", cx: x, cy: y, r: 3.2 });
    if (!known) return;
    const [u, v] = toPlace(known);
    add(svg, "line", { class: "thin", x1: x, y1: y, x2: u, y2: v });
    add(svg, "circle", { class: state.added.has(j) ? "other" : "one", cx: u, cy: v, r: 3.2 });
  });
  TRUE_PATH.forEach((motion) => drawCamera(svg, toPlace, motion, "true", 0.7));
  state.cameras.forEach((motion, c) => {
    const isNew = state.placed && c === state.cameras.length - 1;
    drawCamera(svg, toPlace, motion, isNew ? "other filled" : "one filled", 0.7);
  });
}

const COUNTS = ["seen", "cameras", "points"];

watch(["step", "s", "most"], (values) => {
  const state = wayNumbers(values);
  for (const [name, value] of Object.entries(state.numbers))
    if (COUNTS.includes(name)) showCount(name, value);
    else show(name, value, name === "turn_off" ? "°" : "m");
  byId("what").textContent = values.step === 0 ? WORDS.begin : state.placed ? WORDS.pnp : WORDS.triangulation;
  drawAbove(state);
  told("above-told", WORDS.above_told, state.numbers, COUNTS);
});
