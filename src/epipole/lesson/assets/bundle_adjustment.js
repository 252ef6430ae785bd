/* Bundle adjustment by Levenberg and Marquardt, points eliminated (Triggs et al. 2000, section 6.1). */
/* exported bundleOf, adjustmentSteps */
const HELD = 0,
  SETTLED = 1e-14;

/* Observations that are in view, with noise, and where the adjustment begins; camera 0 begins where it is, and stays there. */
function bundleOf({ visible, s, off }) {
  const { cameras, corners, normals, noise } = SCENE;
  const observations = [];
  corners.forEach((point, j) => {
    cameras.forEach((camera, c) => {
      const sight = unit(minus(inverseMotion(camera).t, point));
      if (dot(sight, normals[j]) < Math.cos(degrees(visible))) return;
      observations.push({ c, j, pixel: plus(project(moved(camera, point)), scaled(noise.pixels[c][j], s)) });
    });
  });
  const start = {
    cameras: cameras.map(({ R, t }, c) => shifted({ R, t }, scaled(noise.cameras[c], c === HELD ? 0 : off))),
    points: corners.map((point, j) => plus(point, scaled(noise.points[j], off))),
  };
  return { observations, start };
}

/* A camera moved from the left: R' = exp(w) R, t' = exp(w) t + v, with x = (v, w). */
function shifted({ R, t }, x) {
  const turn = rotationOf(x.slice(3));
  return { R: times(turn, R), t: plus(applied(turn, t), x.slice(0, 3)) };
}

/* What one observation adds: its residual, and its derivatives by the camera and by the point. */
function linearized({ c, j, pixel }, { cameras, points }) {
  const there = moved(cameras[c], points[j]),
    rows = inCamera(there);
  return {
    left: minus(pixel, project(there)),
    byCamera: rows.map((row) => [...row, ...cross(there, row)]),
    byPoint: rows.map((row) => applied(transposed(cameras[c].R), row)),
  };
}

const addTo = (sum, block) => block.forEach((row, i) => row.forEach((v, k) => (sum[i][k] += v)));
const outer = (rows1, rows2) => times(transposed(rows1), rows2);
const blank = (rows, columns) => Array.from({ length: rows }, () => new Array(columns).fill(0));
const costOf = (observations, state) =>
  0.5 *
  observations.reduce((sum, { c, j, pixel }) => {
    const left = minus(pixel, project(moved(state.cameras[c], state.points[j])));
    return sum + dot(left, left);
  }, 0);

/* Blocks of H = J^T J and of g = J^T r: U and a of cameras, V and b of points, W between them. */
function normalEquations(observations, state) {
  const U = state.cameras.map(() => blank(6, 6)),
    a = state.cameras.map(() => new Array(6).fill(0)),
    V = state.points.map(() => blank(3, 3)),
    b = state.points.map(() => new Array(3).fill(0)),
    W = state.points.map(() => []);
  for (const observation of observations) {
    const { c, j } = observation,
      { left, byCamera, byPoint } = linearized(observation, state);
    addTo(U[c], outer(byCamera, byCamera));
    addTo(V[j], outer(byPoint, byPoint));
    a[c] = plus(a[c], applied(transposed(byCamera), left));
    b[j] = plus(b[j], applied(transposed(byPoint), left));
    W[j].push({ c, block: outer(byCamera, byPoint) });
  }
  return { U, a, V, b, W };
}

const damped = (block, damping) =>
  block.map((row, i) => row.map((v, j) => (i === j ? v * (1 + damping) : v)));

/* The step of (H + damping diag H) x = g: S = U - W V^-1 W^T for the free cameras first, then each point by itself. */
function stepOf({ U, a, V, b, W }, damping) {
  const n = 6 * U.length,
    S = blank(n, n),
    right = a.flat();
  U.forEach((block, c) =>
    damped(block, damping).forEach((row, i) => row.forEach((v, k) => (S[6 * c + i][6 * c + k] = v))),
  );
  const inverses = V.map((block) => inverted(damped(block, damping)));
  W.forEach((seen, j) => {
    for (const one of seen) {
      const Z = times(one.block, inverses[j]);
      applied(Z, b[j]).forEach((v, i) => (right[6 * one.c + i] -= v));
      for (const other of seen) {
        const share = times(Z, transposed(other.block));
        share.forEach((row, i) => row.forEach((v, k) => (S[6 * one.c + i][6 * other.c + k] -= v)));
      }
    }
  });
  const free = S.map((_, k) => k).filter((k) => Math.floor(k / 6) !== HELD);
  const found = solved(
    free.map((i) => free.map((k) => S[i][k])),
    free.map((i) => right[i]),
  );
  const whole = new Array(n).fill(0);
  free.forEach((k, at) => (whole[k] = found[at]));
  const cameras = U.map((_, c) => whole.slice(6 * c, 6 * c + 6));
  const points = V.map((_, j) => {
    const rest = W[j].reduce((sum, { c, block }) => minus(sum, applied(transposed(block), cameras[c])), b[j]);
    return applied(inverses[j], rest);
  });
  return { cameras, points };
}

/* How much the linear model says that a step lowers the cost: half of x^T (damping diag H x + g). */
function predictedFall({ U, a, V, b }, step, damping) {
  const of = (x, block, right) =>
    dot(
      x,
      plus(
        right,
        x.map((v, k) => damping * block[k][k] * v),
      ),
    );
  const cameras = step.cameras.reduce((sum, x, c) => sum + of(x, U[c], a[c]), 0);
  return 0.5 * (cameras + step.points.reduce((sum, x, j) => sum + of(x, V[j], b[j]), 0));
}

/* Every step from the start: the state after it, its cost, the damping that it was taken with (Nielsen 1999). */
function adjustmentSteps({ observations, start }, count) {
  let state = start,
    cost = costOf(observations, start),
    damping = 1e-4,
    growth = 2;
  const steps = [{ state, cost, damping, accepted: true }];
  while (steps.length <= count) {
    const equations = normalEquations(observations, state),
      step = stepOf(equations, damping);
    const candidate = {
      cameras: state.cameras.map((camera, c) => shifted(camera, step.cameras[c])),
      points: state.points.map((point, j) => plus(point, step.points[j])),
    };
    const after = costOf(observations, candidate),
      expected = predictedFall(equations, step, damping),
      gain = (cost - after) / expected,
      accepted = (after <= cost && gain > 0) || expected < SETTLED * cost, // at the end rounding says which is lower
      used = damping;
    if (accepted) {
      [state, cost] = [candidate, after];
      damping = Math.max(1e-9, damping * Math.max(1 / 3, 1 - (2 * Math.min(gain, 1) - 1) ** 3));
      growth = 2;
    } else {
      damping *= growth;
      growth *= 2;
    }
    steps.push({ state, cost, damping: used, accepted });
  }
  return steps;
}
