/* Poses in the plane and motions between them, as `epipole.optim.PoseGraph` of `Rigid2`: a pose is (x, y, angle). */
/* exported composed, optimizedGraph */
const composed = ([x, y, a], [u, v, b]) => [x + Math.cos(a) * u - Math.sin(a) * v, y + Math.sin(a) * u + Math.cos(a) * v, a + b];
const reversed = ([x, y, a]) => [-Math.cos(a) * x - Math.sin(a) * y, Math.sin(a) * x - Math.cos(a) * y, -a];

/* log and exp of SE(2). */
function twistOf([x, y, angle]) {
  const a = Math.atan2(Math.sin(angle), Math.cos(angle)),
    along = Math.abs(a) < 1e-6 ? 1 - (a * a) / 12 : a / 2 / Math.tan(a / 2);
  return [along * x + (a / 2) * y, along * y - (a / 2) * x, a];
}

function motionOfTwist([x, y, a]) {
  const along = Math.abs(a) < 1e-6 ? 1 - (a * a) / 6 : Math.sin(a) / a,
    across = Math.abs(a) < 1e-6 ? a / 2 : (1 - Math.cos(a)) / a;
  return [along * x - across * y, across * x + along * y, a];
}

/* log(z^-1 x_i^-1 x_j), each component divided by its standard deviation. */
const edgeResidual = ({ motion, sigmas }, one, other) =>
  twistOf(composed(reversed(motion), composed(reversed(one), other))).map((v, k) => v / sigmas[k]);

const graphCost = (poses, edges) =>
  0.5 * edges.reduce((sum, edge) => sum + norm(edgeResidual(edge, poses[edge.i], poses[edge.j])) ** 2, 0);

/* Derivatives of an edge by the twist of one of its poses, by central differences. */
function edgeColumns(edge, poses, end) {
  const STEP = 1e-6;
  return [0, 1, 2].map((k) => {
    const at = (sign) => {
      const twist = [0, 0, 0].map((_, i) => (i === k ? sign * STEP : 0)),
        pair = [poses[edge.i], poses[edge.j]];
      pair[end] = composed(pair[end], motionOfTwist(twist));
      return edgeResidual(edge, ...pair);
    };
    return scaled(minus(at(1), at(-1)), 0.5 / STEP);
  });
}

/* Gauss-Newton on all poses but the first, until a step no longer lowers the cost. */
function optimizedGraph(start, edges) {
  let poses = start,
    cost = graphCost(poses, edges);
  const n = 3 * (start.length - 1);
  for (let round = 0; round < 12; round++) {
    const H = Array.from({ length: n }, () => new Array(n).fill(0)),
      g = new Array(n).fill(0);
    for (const edge of edges) {
      const left = edgeResidual(edge, poses[edge.i], poses[edge.j]);
      const columns = [edge.i, edge.j].flatMap((pose, end) =>
        pose === 0 ? [] : edgeColumns(edge, poses, end).map((column, k) => [3 * (pose - 1) + k, column]),
      );
      for (const [row, a] of columns) {
        g[row] -= dot(a, left);
        for (const [column, b] of columns) H[row][column] += dot(a, b);
      }
    }
    const step = solved(H, g);
    const next = poses.map((pose, k) => (k ? composed(pose, motionOfTwist(step.slice(3 * k - 3, 3 * k))) : pose)),
      after = graphCost(next, edges);
    if (!(after < cost)) break;
    const isDone = cost - after < 1e-12 * cost;
    [poses, cost] = [next, after];
    if (isDone) break;
  }
  return { poses, cost };
}
