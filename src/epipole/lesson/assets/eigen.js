/* Symmetric matrices. */
/* exported eigenOf, singularOf, solved */

/* Values in rising order and their vectors (Jacobi 1846: turns in two coordinates until nothing beside the diagonal is left). */
function eigenOf(symmetric) {
  const n = symmetric.length,
    A = symmetric.map((row) => row.slice()),
    V = A.map((_, i) => A.map((_, j) => +(i === j)));
  for (let round = 0; round < 60; round++) {
    let beside = 0;
    for (let p = 0; p < n; p++) for (let q = p + 1; q < n; q++) beside += A[p][q] ** 2;
    if (beside < 1e-300) break;
    for (let p = 0; p < n; p++) {
      for (let q = p + 1; q < n; q++) {
        if (A[p][q] === 0) continue;
        const theta = (A[q][q] - A[p][p]) / (2 * A[p][q]),
          t = (theta >= 0 ? 1 : -1) / (Math.abs(theta) + Math.hypot(theta, 1)),
          c = 1 / Math.hypot(t, 1),
          s = t * c;
        for (let k = 0; k < n; k++) [A[k][p], A[k][q]] = [c * A[k][p] - s * A[k][q], s * A[k][p] + c * A[k][q]];
        for (let k = 0; k < n; k++) [A[p][k], A[q][k]] = [c * A[p][k] - s * A[q][k], s * A[p][k] + c * A[q][k]];
        for (let k = 0; k < n; k++) [V[k][p], V[k][q]] = [c * V[k][p] - s * V[k][q], s * V[k][p] + c * V[k][q]];
      }
    }
  }
  const order = A.map((_, k) => k).sort((a, b) => A[a][a] - A[b][b]);
  return { values: order.map((k) => A[k][k]), vectors: order.map((k) => V.map((row) => row[k])) };
}

/* x of A x = b, by elimination with the largest pivot. */
function solved(A, b) {
  const rows = A.map((row, k) => [...row, b[k]]),
    n = rows.length;
  for (let k = 0; k < n; k++) {
    let best = k;
    for (let i = k + 1; i < n; i++) if (Math.abs(rows[i][k]) > Math.abs(rows[best][k])) best = i;
    [rows[k], rows[best]] = [rows[best], rows[k]];
    for (let i = k + 1; i < n; i++) {
      const factor = rows[i][k] / rows[k][k];
      for (let j = k; j <= n; j++) rows[i][j] -= factor * rows[k][j];
    }
  }
  for (let k = n - 1; k >= 0; k--) {
    for (let j = k + 1; j < n; j++) rows[k][n] -= rows[k][j] * rows[j][n];
    rows[k][n] /= rows[k][k];
  }
  return rows.map((row) => row[n]);
}

/* Singular values in falling order, with the vectors of both sides: columns are turned until each two are at right angles
   (Hestenes 1958). */
function singularOf(matrix) {
  const columns = transposed(matrix),
    n = columns.length,
    V = columns.map((_, i) => columns.map((_, j) => +(i === j)));
  const turn = (rows, p, q, c, s) => {
    [rows[p], rows[q]] = [minus(scaled(rows[p], c), scaled(rows[q], s)), plus(scaled(rows[p], s), scaled(rows[q], c))];
  };
  for (let round = 0, worst = 1; round < 60 && worst > 1e-15; round++) {
    worst = 0;
    for (let p = 0; p < n; p++) {
      for (let q = p + 1; q < n; q++) {
        const a = dot(columns[p], columns[p]),
          b = dot(columns[q], columns[q]),
          g = dot(columns[p], columns[q]);
        if (g === 0) continue;
        worst = Math.max(worst, Math.abs(g) / Math.sqrt(a * b));
        const zeta = (b - a) / (2 * g),
          t = (zeta >= 0 ? 1 : -1) / (Math.abs(zeta) + Math.hypot(1, zeta)),
          c = 1 / Math.hypot(1, t);
        turn(columns, p, q, c, c * t);
        turn(V, p, q, c, c * t);
      }
    }
  }
  const sizes = columns.map(norm),
    order = sizes.map((_, k) => k).sort((a, b) => sizes[b] - sizes[a]);
  return {
    values: order.map((k) => sizes[k]),
    left: order.map((k) => scaled(columns[k], 1 / sizes[k])),
    right: order.map((k) => V[k]),
  };
}
