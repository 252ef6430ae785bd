/* Gauss-Newton on distances in pictures: a point between known cameras, a camera before known points. */
/* exported inCamera, pixelDerivative, refinedPoint, refinedCamera */

/* Derivative of a pixel by the point before the camera, by rows. */
function inCamera([x, y, z]) {
  const f = K[0][0] / z;
  return [
    [f, 0, (-f * x) / z],
    [0, f, (-f * y) / z],
  ];
}

/* By the point in the world. */
const pixelDerivative = ({ R }, there) => inCamera(there).map((row) => applied(transposed(R), row));

/* The step that makes |J x - left| smallest; damped, it is shorter and turned downhill. */
function leastSquares(rows, left, damping = 0) {
  const columns = transposed(rows);
  return solved(
    columns.map((a, i) => columns.map((b, j) => dot(a, b) * (i === j ? 1 + damping : 1))),
    columns.map((a) => dot(a, left)),
  );
}

/* The point whose projections are nearest to the pixels. */
function refinedPoint(motions, pixels, start) {
  let point = start;
  for (let round = 0; round < 20; round++) {
    const there = motions.map((motion) => moved(motion, point));
    const rows = motions.flatMap((motion, k) => pixelDerivative(motion, there[k]));
    const step = leastSquares(
      rows,
      there.flatMap((p, k) => minus(pixels[k], project(p))),
    );
    point = plus(point, step);
    if (!(norm(step) > 1e-14 * norm(point))) break;
  }
  return point;
}

/* Pixels that a camera leaves over; infinite where a point is not in front of it. */
function cameraResiduals(motion, points, pixels) {
  const there = points.map((point) => moved(motion, point));
  return there.some(([, , z]) => z < 0.05)
    ? [Infinity]
    : there.flatMap((p, k) => minus(pixels[k], project(p)));
}

/* The camera whose projections of the points are nearest to the pixels, moved by exp(w) from the left: J = d pixel [I, -[x]].
   Levenberg and Marquardt: a step that makes the sum larger is refused and damped. */
function refinedCamera(points, pixels, start) {
  let camera = start,
    left = cameraResiduals(camera, points, pixels),
    damping = 1e-6;
  for (let round = 0; round < 80 && damping < 1e9; round++) {
    const there = points.map((point) => moved(camera, point));
    const rows = there.flatMap((p) => inCamera(p).map((row) => [...row, ...cross(p, row)]));
    const step = leastSquares(rows, left, damping),
      turn = rotationOf(step.slice(3));
    const candidate = { R: times(turn, camera.R), t: plus(applied(turn, camera.t), step.slice(0, 3)) },
      next = cameraResiduals(candidate, points, pixels);
    // Near the end, rounding says which sum is larger.
    if (!(dot(next, next) <= dot(left, left) * (1 + 1e-12))) {
      damping = 10 * Math.max(damping, 1e-6);
      continue;
    }
    [camera, left, damping] = [candidate, next, damping / 10];
    if (norm(step) < 1e-13) break;
  }
  return camera;
}
