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

/* The step that makes |J x - left| smallest. */
function leastSquares(rows, left) {
  const columns = transposed(rows);
  return solved(
    columns.map((a) => columns.map((b) => dot(a, b))),
    columns.map((a) => dot(a, left)),
  );
}

/* The point whose projections are nearest to the pixels. */
function refinedPoint(motions, pixels, start) {
  let point = start;
  for (let round = 0; round < 20; round++) {
    const there = motions.map((motion) => moved(motion, point));
    const rows = motions.flatMap((motion, k) => pixelDerivative(motion, there[k]));
    const step = leastSquares(rows, there.flatMap((p, k) => minus(pixels[k], project(p))));
    point = plus(point, step);
    if (!(norm(step) > 1e-14 * norm(point))) break;
  }
  return point;
}

/* The camera whose projections of the points are nearest to the pixels, moved by exp(w) from the left: J = d pixel [I, -[x]]. */
function refinedCamera(points, pixels, start) {
  let { R, t } = start;
  for (let round = 0; round < 30; round++) {
    const there = points.map((point) => moved({ R, t }, point));
    const rows = there.flatMap((p) => inCamera(p).map((row) => [...row, ...cross(p, row)]));
    const step = leastSquares(rows, there.flatMap((p, k) => minus(pixels[k], project(p))));
    const turn = rotationOf(step.slice(3));
    R = times(turn, R);
    t = plus(applied(turn, t), step.slice(0, 3));
    if (!(norm(step) > 1e-13)) break;
  }
  return { R, t };
}
