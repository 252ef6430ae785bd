/* Vectors and 3 x 3 matrices, as rows. */
/* exported dot, cross, plus, minus, scaled, norm, unit, times, applied, transposed, skew, inverted, rotationOf, determinant, moved, inverseMotion */
const dot = (a, b) => a.reduce((sum, v, k) => sum + v * b[k], 0);
const plus = (a, b) => a.map((v, k) => v + b[k]);
const minus = (a, b) => a.map((v, k) => v - b[k]);
const scaled = (a, s) => a.map((v) => v * s);
const norm = (a) => Math.sqrt(dot(a, a));
const unit = (a) => scaled(a, 1 / norm(a));
const cross = ([a, b, c], [x, y, z]) => [b * z - c * y, c * x - a * z, a * y - b * x];
const skew = ([x, y, z]) => [
  [0, -z, y],
  [z, 0, -x],
  [-y, x, 0],
];
const transposed = (A) => A[0].map((_, k) => A.map((row) => row[k]));
const applied = (A, v) => A.map((row) => dot(row, v));
const times = (A, B) => {
  const columns = transposed(B);
  return A.map((row) => columns.map((column) => dot(row, column)));
};
const determinant = (A) => dot(A[0], cross(A[1], A[2]));
const inverted = (A) => {
  const [a, b, c] = A,
    all = determinant(A);
  return transposed([cross(b, c), cross(c, a), cross(a, b)]).map((row) => scaled(row, 1 / all));
};

/* exp of a rotation vector (Rodrigues 1840), as `epipole.geometry.Rotation3.exp`. */
function rotationOf(vector) {
  const angle = norm(vector),
    W = skew(vector),
    W2 = times(W, W);
  const a = angle < 1e-4 ? 1 - (angle * angle) / 6 : Math.sin(angle) / angle;
  const b = angle < 1e-4 ? 0.5 - (angle * angle) / 24 : (1 - Math.cos(angle)) / (angle * angle);
  return W.map((row, i) => row.map((w, j) => (i === j) + a * w + b * W2[i][j]));
}

/* A motion {R, t} on a point, and the motion back. */
const moved = ({ R, t }, point) => plus(applied(R, point), t);
const inverseMotion = ({ R, t }) => ({ R: transposed(R), t: scaled(applied(transposed(R), t), -1) });
