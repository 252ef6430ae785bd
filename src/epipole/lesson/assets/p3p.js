/* All camera poses that three points leave. */
/* exported posesOfThree */

/* Distances of three points from the camera (Grunert 1841). Two sides of the triangle give the second and the third distance
   from the first one, each with two signs; the third side is then an equation in the first distance. Its roots are found
   by changes of sign on a grid, and by halving. */
function distancesOfThree(rays, points) {
  const side = (i, j) => norm(minus(points[i], points[j])),
    cosine = (i, j) => dot(rays[i], rays[j]);
  const height = (j) => side(0, j) / Math.sqrt(1 - cosine(0, j) ** 2),
    most = Math.min(height(1), height(2));
  const other = (first, j, sign) => {
    const root = Math.sqrt(Math.max(0, side(0, j) ** 2 - first ** 2 * (1 - cosine(0, j) ** 2)));
    return first * cosine(0, j) + sign * root;
  };
  const found = [];
  for (const [sign1, sign2] of [[1, 1], [1, -1], [-1, 1], [-1, -1]]) {
    const at = (first) => [first, other(first, 1, sign1), other(first, 2, sign2)];
    const left = (first) => {
      const [, b, c] = at(first);
      return b * b + c * c - 2 * b * c * cosine(1, 2) - side(1, 2) ** 2;
    };
    for (const first of rootsOf(left, most, 2000)) {
      const distances = at(first);
      if (Math.min(...distances) > 1e-9 && !found.some((one) => norm(minus(one, distances)) < 1e-7)) found.push(distances);
    }
  }
  return found;
}

/* Where a function changes its sign between 0 and `most`. */
function rootsOf(value, most, steps) {
  const out = [];
  for (let k = 0; k < steps; k++) {
    let [low, high] = [(most * k) / steps, (most * (k + 1)) / steps];
    const sign = Math.sign(value(low));
    if (sign === Math.sign(value(high))) continue;
    for (let round = 0; round < 60; round++) {
      const middle = (low + high) / 2;
      if (Math.sign(value(middle)) === sign) low = middle;
      else high = middle;
    }
    out.push((low + high) / 2);
  }
  return out;
}

/* Three directions at right angles, of a triangle: as columns. */
function frameOf([a, b, c]) {
  const x = unit(minus(b, a)),
    z = unit(cross(x, minus(c, a)));
  return transposed([x, cross(z, x), z]);
}

/* As `epipole.solvers.solve_p3p`: all cam_from_world with the points on their rays, in front of the camera. */
function posesOfThree(rays, points) {
  const ways = rays.map(unit);
  return distancesOfThree(ways, points).map((distances) => {
    const inCamera = ways.map((way, k) => scaled(way, distances[k])),
      R = times(frameOf(inCamera), transposed(frameOf(points)));
    return { R, t: minus(inCamera[0], applied(R, points[0])) };
  });
}
