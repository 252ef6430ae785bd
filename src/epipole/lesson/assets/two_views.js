/* Models of two pictures from matches, after Hartley's normalisation (PAMI 1997). */
/* exported fundamentalFrom, homographyFrom, rotationFrom, essentialFrom, sampsonOf, transferOf */
const matrixOf = ([a, b, c, d, e, f, g, h, i]) => [
  [a, b, c],
  [d, e, f],
  [g, h, i],
];

/* T with T x of mean zero and mean distance sqrt(2), as `hartley_normalization`. */
function normalization(pixels) {
  const n = pixels.length,
    center = scaled(pixels.reduce(plus), 1 / n);
  const s = Math.SQRT2 / (pixels.reduce((sum, p) => sum + norm(minus(p, center)), 0) / n);
  return [
    [s, 0, -s * center[0]],
    [0, s, -s * center[1]],
    [0, 0, 1],
  ];
}

const normalized = (T, pixels) => pixels.map(([u, v]) => applied(T, [u, v, 1]));
const nullVector = (rows) => singularOf(rows).right.at(-1);

/* Eight points and more, made of rank 2: `solve_fundamental_eight_point`. */
function fundamentalFrom(pixels1, pixels2) {
  const [T1, T2] = [pixels1, pixels2].map(normalization),
    [x1, x2] = [normalized(T1, pixels1), normalized(T2, pixels2)];
  const free = matrixOf(nullVector(x1.map((a, k) => x2[k].flatMap((v) => scaled(a, v)))));
  const { values, left, right } = singularOf(free);
  const F = free.map((row, i) => row.map((v, j) => v - values[2] * left[2][i] * right[2][j]));
  return times(times(transposed(T2), F), T1);
}

/* x2 ~ H x1: `solve_homography_dlt`. */
function homographyFrom(pixels1, pixels2) {
  const [T1, T2] = [pixels1, pixels2].map(normalization),
    [x1, x2] = [normalized(T1, pixels1), normalized(T2, pixels2)];
  const none = [0, 0, 0];
  const rows = x1.flatMap((x, k) => [
    [...x, ...none, ...scaled(x, -x2[k][0])],
    [...none, ...x, ...scaled(x, -x2[k][1])],
  ]);
  return times(inverted(T2), times(matrixOf(nullVector(rows)), T1));
}

/* The turn that brings rays 1 onto rays 2 (Horn 1987: the quaternion is an eigenvector; Kabsch's 1976 is the same turn). */
function rotationFrom(rays1, rays2) {
  const M = [0, 1, 2].map((i) => [0, 1, 2].map((j) => rays1.reduce((sum, a, k) => sum + a[i] * rays2[k][j], 0)));
  const [[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]] = M;
  const [w, x, y, z] = eigenOf([
    [xx + yy + zz, yz - zy, zx - xz, xy - yx],
    [yz - zy, xx - yy - zz, xy + yx, zx + xz],
    [zx - xz, xy + yx, yy - xx - zz, yz + zy],
    [xy - yx, zx + xz, yz + zy, zz - xx - yy],
  ]).vectors.at(-1);
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

/* Sampson's distance with its sign, in the four coordinates of a match. */
function sampsonOf(F, [u, v], [u2, v2]) {
  const second = applied(F, [u, v, 1]),
    first = applied(transposed(F), [u2, v2, 1]);
  return dot(second, [u2, v2, 1]) / Math.hypot(second[0], second[1], first[0], first[1]);
}

/* How far H x1 is from x2, as a distance in those four coordinates: both pictures share it. */
const transferOf = (H, pixel, match) => norm(minus(pixelOf(applied(H, [...pixel, 1])), match)) / Math.SQRT2;

/* The essential matrix with the smallest sum of squared Sampson distances, from a start: Gauss-Newton in its five numbers. */
function essentialFrom(pixels1, pixels2, { R, t }) {
  const fundamentalAt = (R, t) => times(times(transposed(K_INVERSE), times(skew(t), R)), K_INVERSE);
  const residuals = (R, t) => pixels1.map((pixel, k) => sampsonOf(fundamentalAt(R, t), pixel, pixels2[k]));
  const sizeOf = (values) => dot(values, values);
  t = norm(t) > 1e-9 ? unit(t) : [1, 0, 0];
  let left = residuals(R, t),
    damping = 1e-6;
  for (let round = 0; round < 60 && damping < 1e8; round++) {
    const across = unit(cross(t, Math.abs(t[0]) < 0.7 ? [1, 0, 0] : [0, 1, 0])),
      sides = [across, cross(t, across)];
    const stepped = (x) => [
      times(rotationOf(x.slice(0, 3)), R),
      unit(plus(t, plus(scaled(sides[0], x[3]), scaled(sides[1], x[4])))),
    ];
    const columns = [0, 1, 2, 3, 4].map((k) => {
      const ends = [1e-5, -1e-5].map((h) => residuals(...stepped([0, 0, 0, 0, 0].map((_, j) => (j === k ? h : 0)))));
      return scaled(minus(...ends), 5e4);
    });
    const A = columns.map((a, i) => columns.map((b, j) => dot(a, b) * (i === j ? 1 + damping : 1)));
    const downhill = columns.map((a) => -dot(a, left)),
      step = solved(A, downhill);
    if (dot(step, downhill) < 1e-18 * sizeOf(left)) break;
    const [nextR, nextT] = stepped(step),
      next = residuals(nextR, nextT);
    if (sizeOf(next) < sizeOf(left)) {
      const done = sizeOf(left) - sizeOf(next) < 1e-15 * sizeOf(left);
      [R, t, left, damping] = [nextR, nextT, next, damping / 10];
      if (done) break;
    } else damping *= 10;
  }
  return fundamentalAt(R, t);
}
