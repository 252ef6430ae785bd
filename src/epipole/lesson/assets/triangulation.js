/* Two rays with noise: the point of linear equations, the point that explains the pixels best, and its covariance. */

/* As `epipole.geometry.triangulate_linear`: (I - d d^T) [R t] X = 0, by the smallest eigenvalue of its normal equations. */
function linearPoint(motions, rays) {
  const size = Math.max(...motions.flatMap(({ t }) => t.map(Math.abs))) || 1;
  const rows = motions.flatMap(({ R, t }, k) => {
    const d = unit(rays[k]),
      M = R.map((row, i) => [...row, t[i] / size]);
    const along = transposed(M).map((column) => dot(d, column));
    return M.map((row, i) => row.map((v, j) => v - d[i] * along[j]));
  });
  const columns = transposed(rows);
  const [x, y, z, w] = eigenOf(columns.map((a) => columns.map((b) => dot(a, b)))).vectors[0];
  return scaled([x, y, z], size / w);
}

/* sigma^2 (sum of J^T J)^-1, as `epipole.robust.point_covariances`. */
function covarianceOf(motions, point, sigma) {
  const columns = transposed(motions.flatMap((motion) => pixelDerivative(motion, moved(motion, point))));
  return inverted(columns.map((a) => columns.map((b) => dot(a, b)))).map((row) => scaled(row, sigma * sigma));
}

function errorPx(motions, pixels, point) {
  const off = motions.map((motion, k) => minus(pixels[k], project(moved(motion, point)))).flat();
  return Math.sqrt(dot(off, off) / off.length);
}

function pointNumbers({ B, A, Z, X, s, n }) {
  const motions = [HERE, motionOf({ tx: B, tz: A })],
    truth = [X, 0.2, Z];
  const found = SCENE.noise.map((noise) => {
    const pixels = motions.map((motion, k) =>
      plus(project(moved(motion, truth)), scaled(noise.slice(2 * k, 2 * k + 2), s)),
    );
    const linear = linearPoint(motions, pixels.map(rayOf));
    return { pixels, linear, best: refinedPoint(motions, pixels, linear) };
  });
  const { pixels, linear, best } = found[n];
  const covariance = covarianceOf(motions, truth, s);
  const [one, other] = [truth, minus(truth, [B, 0, A])],
    flat = [0, 2].map((i) => [0, 2].map((k) => covariance[i][k])),
    axes = eigenOf(flat),
    seen = pixels.map((pixel, k) => unit(applied(transposed(motions[k].R), rayOf(pixel)))),
    between = cross(...seen);
  return {
    motions,
    truth,
    linear,
    best,
    axes,
    seen,
    others: found.map((case_) => case_.best),
    numbers: {
      angle: (Math.atan2(norm(cross(one, other)), dot(one, other)) * 180) / Math.PI,
      gap: Math.abs(dot([B, 0, A], between)) / norm(between),
      short: Math.sqrt(axes.values[0]),
      long: Math.sqrt(axes.values[1]),
      sx: Math.sqrt(covariance[0][0]),
      sz: Math.sqrt(covariance[2][2]),
      linear: norm(minus(linear, truth)),
      linear_px: errorPx(motions, pixels, linear),
      best: norm(minus(best, truth)),
      best_px: errorPx(motions, pixels, best),
    },
  };
}

/* The scale of the view (meters from its center to its edge), and the ellipse before the slider that moves now was touched. */
const VIEW = { reach: 0, before: null, moved: "", values: null, axes: null };
const semiAxisPx = (long) => (2 * long * 200) / VIEW.reach;

function roundUp(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].map((k) => k * power).find((round) => round >= value);
}

/* Keep the scale while one slider moves, so that a larger ellipse is drawn larger; renew it only where the ellipse leaves the
   view or shrinks to a dot. */
function holdScale(values, axes) {
  const long = Math.sqrt(axes.values[1]),
    changed = VIEW.values ? Object.keys(values).filter((name) => values[name] !== VIEW.values[name]).join() : "";
  if (!VIEW.values) VIEW.reach = roundUp(2.8 * long);
  if (changed && changed !== VIEW.moved) {
    const longBefore = Math.sqrt(VIEW.axes.values[1]),
      isReadable = semiAxisPx(longBefore) >= 40 && semiAxisPx(longBefore) <= 110;
    if (!isReadable) VIEW.reach = roundUp(2.8 * longBefore);
    [VIEW.before, VIEW.moved] = [VIEW.axes, changed];
  }
  if (semiAxisPx(long) > 210 || semiAxisPx(long) < 6) VIEW.reach = roundUp(2.8 * long);
  [VIEW.values, VIEW.axes] = [values, axes];
}

/* Two standard deviations around a center. */
function drawEllipse(svg, { values, vectors }, [cx, cy], size, kind) {
  const turned = (-Math.atan2(vectors[1][1], vectors[1][0]) * 180) / Math.PI;
  add(svg, "ellipse", {
    class: kind,
    cx,
    cy,
    rx: 2 * size * Math.sqrt(values[1]),
    ry: 2 * size * Math.sqrt(values[0]),
    transform: `rotate(${turned} ${cx} ${cy})`,
  });
}

/* Marks that can be told apart where they lie on each other. */
const MARKS = {
  truth: "m-9,0 h18 m-9,-9 v18",
  dlt: "m-8,-8 h16 v16 h-16 z",
  refined: "m0,-6 l6,6 l-6,6 l-6,-6 z",
};

function drawMarks(svg, points, toPlace) {
  Object.entries(points).forEach(([name, point], k) => {
    const y = 24 + 24 * k;
    add(svg, "path", { class: name, d: `M${toPlace(point)} ${MARKS[name]}` });
    add(svg, "path", { class: name, d: `M22,${y} ${MARKS[name]}` });
    add(svg, "text", { class: "label", x: 38, y: y + 4 }, WORDS[name]);
  });
}

function drawAbove({ truth, linear, best, axes, seen, others }, centers) {
  const [svg, width] = fitted("above", 440),
    { reach, before } = VIEW,
    size = 200 / reach;
  const toPlace = ([x, , z]) => [width / 2 + size * (x - truth[0]), 220 - size * (z - truth[2])];
  centers.forEach(([x, z], k) => {
    // The ray of the noisy pixel, as far as the drawing goes.
    const way = seen[k],
      nearest = dot(minus(truth, [x, 0, z]), way);
    const ends = [-3, 3].map((along) => plus([x, 0, z], scaled(way, nearest + along * reach)));
    const [a, b] = ends.map(toPlace);
    add(svg, "line", { class: "ray " + ["one", "other"][k], x1: a[0], y1: a[1], x2: b[0], y2: b[1] });
  });
  drawEllipse(svg, axes, toPlace(truth), size, "spread");
  if (before) drawEllipse(svg, before, toPlace(truth), size, "before");
  for (const point of others) {
    const [x, y] = toPlace(point);
    add(svg, "circle", { class: "case", cx: x, cy: y, r: 2.2 });
  }
  drawMarks(svg, { truth, dlt: linear, refined: best }, toPlace);
  const step = marks(reach, 3)[1];
  add(svg, "path", {
    class: "measure",
    d: `M${width - 16},420 h${-size * step} m0,-5 v10 M${width - 16},415 v10`,
  });
  add(
    svg,
    "text",
    { class: "tick", x: width - 16, y: 408, "text-anchor": "end" },
    withUnit(+step.toPrecision(3), "m", 1),
  );
}

watch(["B", "A", "Z", "X", "s", "n"], (values) => {
  const found = pointNumbers(values);
  for (const [name, value] of Object.entries(found.numbers))
    show(name, value, name === "angle" ? "°" : name.endsWith("_px") ? WORDS.unit_px : "m");
  holdScale(values, found.axes);
  drawAbove(found, [
    [0, 0],
    [values.B, values.A],
  ]);
  told("above-told", WORDS.above_told, found.numbers);
});
