/* Structure from motion as in the page's steps: a pair, its points, the next cameras, and bundle adjustment of it all. */
/* exported reconstructed, centerOf, LAST_STAGE */
const centerOf = (motion) => inverseMotion(motion).t,
  LEAST_ANGLE = degrees(1.5),
  VISIBLE = Math.cos(degrees(95)),
  LAST_STAGE = 6;

/* Pixels of all points in camera c, with noise; null where a point faces away. */
function pixelsOf(c, s) {
  const camera = SCENE.cameras[c];
  return SCENE.corners.map((point, j) => {
    const sight = unit(minus(centerOf(camera), point));
    if (dot(sight, SCENE.normals[j]) < VISIBLE) return null;
    return plus(project(moved(camera, point)), scaled(SCENE.noise[c][j], s));
  });
}

/* The motion that an essential matrix has, by its singular vectors: of the four, the one with the most points before both cameras. */
function motionFrom(E, rays1, rays2) {
  const { left, right } = singularOf(E),
    t = unit(cross(left[0], left[1]));
  const U = transposed([left[0], left[1], t]),
    V = [right[0], right[1], cross(right[0], right[1])];
  const candidates = [-1, 1].flatMap((sign) => {
    const R = times(times(U, [[0, -sign, 0], [sign, 0, 0], [0, 0, 1]]), V);
    return [t, scaled(t, -1)].map((direction) => ({ R, t: direction }));
  });
  const ahead = candidates.map(
    (motion) =>
      rays1.filter((ray, k) => {
        const { along1, along2 } = triangulated(motion, ray, rays2[k]);
        return along1 > 0 && along2 > 0;
      }).length,
  );
  return candidates[ahead.indexOf(Math.max(...ahead))];
}

/* The relative motion of two images with |t| = 1: eight points, then the smallest sum of Sampson distances. */
function pairMotion(pixels1, pixels2) {
  const rays = [pixels1, pixels2].map((pixels) => pixels.map(rayOf));
  const essential = (F) => times(times(transposed(K), F), K);
  const begun = motionFrom(essential(fundamentalFrom(pixels1, pixels2)), ...rays);
  return motionFrom(essential(essentialFrom(pixels1, pixels2, begun)), ...rays);
}

const seenInBoth = (one, other) => one.map((_, j) => j).filter((j) => one[j] && other[j]);

/* The first two cameras: the first is where it is, and the length of the baseline is known. */
function placePair(state, pixels) {
  const both = seenInBoth(pixels[0], pixels[1]),
    { R, t } = pairMotion(...[0, 1].map((c) => both.map((j) => pixels[c][j])));
  const [first, second] = SCENE.cameras,
    baseline = norm(minus(centerOf(first), centerOf(second)));
  state.cameras.push(first, { R: times(R, first.R), t: plus(applied(R, first.t), scaled(t, baseline)) });
  state.used = both.length;
}

/* The next camera by the points that are known: it starts where the last one stands. */
function placeNext(state, pixels) {
  const c = state.cameras.length,
    known = [...state.points.keys()].filter((j) => pixels[c][j]);
  const points = known.map((j) => state.points.get(j)),
    seen = known.map((j) => pixels[c][j]);
  state.cameras.push(refinedCamera(points, seen, state.cameras.at(-1)));
  state.used = known.length;
}

/* Points that the newest camera and the earliest one that sees them give, if their rays meet at an angle. */
function addPoints(state, pixels) {
  const last = state.cameras.length - 1;
  state.added = new Set();
  SCENE.corners.forEach((_, j) => {
    const first = pixels.findIndex((seen) => seen[j]);
    if (state.points.has(j) || !pixels[last][j] || first >= last) return;
    const motions = [state.cameras[first], state.cameras[last]],
      R = times(motions[1].R, transposed(motions[0].R)),
      between = { R, t: minus(motions[1].t, applied(R, motions[0].t)) };
    const both = [pixels[first][j], pixels[last][j]],
      begun = moved(inverseMotion(motions[0]), triangulated(between, ...both.map(rayOf)).point);
    const point = refinedPoint(motions, both, begun),
      [a, b] = motions.map((motion) => minus(point, centerOf(motion)));
    if (motions.some((motion) => moved(motion, point)[2] <= 0)) return;
    if (Math.atan2(norm(cross(a, b)), dot(a, b)) < LEAST_ANGLE) return;
    state.points.set(j, point);
    state.added.add(j);
  });
}

/* All cameras and points at once: only points that are known take part. */
function adjustAll(state, pixels) {
  const known = [...state.points.keys()];
  const observations = known.flatMap((j, row) =>
    state.cameras.flatMap((_, c) => (pixels[c][j] ? [{ c, j: row, pixel: pixels[c][j] }] : [])),
  );
  const start = { cameras: state.cameras, points: known.map((j) => state.points.get(j)) },
    found = adjustmentSteps({ observations, start }, 10).at(-1);
  state.cameras = found.state.cameras;
  state.points = new Map(known.map((j, row) => [j, found.state.points[row]]));
  state.added = new Set();
}

/* Distances of the projections of known points from their pixels, over all cameras that are registered. */
function reprojections(state, pixels) {
  return state.cameras.flatMap((camera, c) =>
    [...state.points].flatMap(([j, point]) =>
      pixels[c][j] ? [norm(minus(project(moved(camera, point)), pixels[c][j]))] : [],
    ),
  );
}

/* The model after a stage: 0 features and matches, 1 the pair, 2 its points, 3 the next camera, 4 its points, 5 the other cameras
   in the same way, 6 bundle adjustment. */
function reconstructed(stage, s) {
  const pixels = SCENE.cameras.map((_, c) => pixelsOf(c, s)),
    state = { cameras: [], points: new Map(), added: new Set(), used: 0, pixels };
  if (stage === 0) state.used = seenInBoth(pixels[0], pixels[1]).length;
  if (stage >= 1) placePair(state, pixels);
  if (stage >= 2) addPoints(state, pixels);
  if (stage >= 3) placeNext(state, pixels);
  if (stage >= 4) addPoints(state, pixels);
  while (stage >= 5 && state.cameras.length < pixels.length) {
    placeNext(state, pixels);
    addPoints(state, pixels);
  }
  if (stage === 3) state.added = new Set();
  if (stage >= 6) adjustAll(state, pixels);
  const off = reprojections(state, pixels);
  state.mean = off.length ? off.reduce((sum, v) => sum + v, 0) / off.length : NaN;
  return state;
}
