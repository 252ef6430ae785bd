/* The small figures of the page on models: the homography of a plane, a pure rotation, and many epipoles of one plane. */

/* x2 ~ H x1 for the plane n . X = d before the first camera, as in `epipole.geometry.planes`: H = K (R + t n^T / d) K^-1. */
function planeHomography({ R, t }, n, d) {
  const bent = R.map((row, i) => row.map((v, j) => v + (t[i] * n[j]) / d));
  return times(times(K, bent), K_INVERSE);
}

const mapped = (H, [u, v]) => pixelOf(applied(H, [u, v, 1]));
const SIDE = motionOf({ tx: 1.8, ty: -0.3, yaw: -20 });

/* A plane through (0.5, 0, 3.4), tilted about the vertical axis: its normal, its distance, and its points at (across, down). */
function tiltedPlane(tilt) {
  const across = [Math.cos(degrees(tilt)), 0, Math.sin(degrees(tilt))],
    n = [-across[2], 0, across[0]],
    middle = [0.5, 0, 3.4];
  const at = (a, b) => plus(middle, plus(scaled(across, a), [0, b, 0]));
  return { n, d: dot(n, middle), at };
}

const GRID = [-1, -0.5, 0, 0.5, 1];

/* Points of the plane, one point beside it, and how far the homography is from each in the second image. */
function planeNumbers({ tilt, lift }) {
  const { n, d, at } = tiltedPlane(tilt),
    H = planeHomography(SIDE, n, d);
  const points = GRID.flatMap((a) => GRID.map((b) => at(1.2 * a, 0.9 * b))),
    off = minus(at(0.6, -0.45), scaled(n, lift));
  const missed = (point) => norm(minus(mapped(H, project(point)), project(moved(SIDE, point))));
  const foot = scaled(off, d / dot(n, off)); // where its ray meets the plane
  return { at, points, off, foot, on: Math.max(...points.map(missed)), beside: missed(off) };
}

const SHEET_AT = 0.9;
const imageIn = (motion, point) => {
  const [x, y, z] = moved(motion, point);
  return moved(inverseMotion(motion), [(SHEET_AT * x) / z, (SHEET_AT * y) / z, SHEET_AT]);
};
const drawPlane = space("plane3d", { center: [0.7, -0.05, 1.8], distance: 7.4, yaw: -0.45, pitch: 0.42, zoom: 1.45 }, 340);

watch(["tilt", "lift"], (values) => {
  const { at, points, off, foot, on, beside } = planeNumbers(values);
  drawPlane((put) => {
    put.area([at(-1.5, -1.15), at(1.5, -1.15), at(1.5, 1.15), at(-1.5, 1.15)], "sheet");
    points.forEach((point) => put.dot(point, "point", 3));
    put.camera(HERE, "one", SHEET_AT);
    put.camera(SIDE, "other", SHEET_AT);
    put.line([0, 0, 0], foot, "ray one");
    if (norm(off) > norm(foot)) put.line(foot, off, "ray one");
    put.line(inverseMotion(SIDE).t, off, "ray other");
    put.line(inverseMotion(SIDE).t, foot, "dashed");
    put.line(imageIn(SIDE, off), imageIn(SIDE, foot), "measure");
    put.dot(imageIn(HERE, off), "one", 5);
    put.dot(imageIn(SIDE, foot), "behind", 5);
    put.dot(imageIn(SIDE, off), "other", 5);
    put.dot(foot, "behind", 6);
    put.dot(off, "object", 7);
    put.label([0, 0, 0], WORDS.first_camera, -6, 22);
    put.label(inverseMotion(SIDE).t, WORDS.second_camera, -40, 24);
  });
  show("on", on, WORDS.unit_px);
  show("beside", beside, WORDS.unit_px);
  told("plane3d-told", WORDS.plane_told, { beside });
});

/* Points at many depths, one behind the other, and what a rotation leaves of their motion. */
const DEEP = Array.from({ length: 35 }, (_, k) => {
  const [u, v] = [70 + 83 * (k % 7) + 24 * (Math.floor(k / 7) % 2), 60 + 88 * Math.floor(k / 7)];
  return scaled(rayOf([u, v]), 1.5 * 1.075 ** ((k * 11) % 35));
});

function flowNumbers({ rx, ry }) {
  const motion = motionOf({ tx: rx, yaw: ry }),
    H = times(times(K, motion.R), K_INVERSE);
  const flow = DEEP.map((point) => ({
    depth: point[2],
    from: mapped(H, project(point)),
    to: project(moved(motion, point)),
  }));
  const sorted = flow.slice().sort((a, b) => a.depth - b.depth),
    length = ({ from, to }) => norm(minus(to, from));
  return { flow, nearest: sorted[0], farthest: sorted.at(-1), near: length(sorted[0]), far: length(sorted.at(-1)) };
}

/* An image in the middle of a drawing, and where it ends below. */
function oneImage(id) {
  const wide = (all) => Math.min(all - 24, 400),
    [svg, width] = fitted(id, (all) => 0.75 * wide(all) + 76);
  return [svg, picture(svg, (width - wide(width)) / 2, 26, wide(width), WORDS.second), width, 26 + 0.75 * wide(width)];
}

watch(["ry", "rx"], (values) => {
  const { flow, nearest, farthest, near, far } = flowNumbers(values),
    [svg, inside, width, end] = oneImage("flow");
  flow.forEach(({ depth, from, to }) => {
    add(inside, "line", { class: "residual", x1: from[0], y1: from[1], x2: to[0], y2: to[1] });
    add(inside, "circle", { class: "other", cx: to[0], cy: to[1], r: 22 / depth + 2 });
  });
  const px = (words, point, value) => worded(words, { depth: withUnit(point.depth, "m", 2), length: withUnit(value, WORDS.unit_px) });
  const line = (text, y) => add(svg, "text", { class: "label", x: width / 2, y, "text-anchor": "middle" }, text);
  line(px(WORDS.nearest, nearest, near), end + 20);
  line(px(WORDS.farthest, farthest, far), end + 40);
  told("flow-told", WORDS.flow_told, { near, far });
});

/* A plane seen from both sides, and lines through an epipole of choice: F = [e']x H. */
const WALL = tiltedPlane(15),
  ASIDE = motionOf({ tx: 0.7, ty: -0.2, tz: 0.9, yaw: -6 });
const WALL_POINTS = [-1, -0.3, 0.4, 1.1].flatMap((a) => [-0.8, 0, 0.8].map((b) => WALL.at(1.1 * a, b)));
const BESIDE_POINTS = [minus(WALL.at(-0.7, -0.5), scaled(WALL.n, 1.1)), minus(WALL.at(0.5, 0.45), scaled(WALL.n, 0.9))];

function pencilNumbers({ eu, ev }) {
  const H = planeHomography(ASIDE, WALL.n, WALL.d),
    F = times(skew([eu, ev, 1]), H);
  const seen = (point) => {
    const line = applied(F, [...project(point), 1]),
      match = project(moved(ASIDE, point));
    return { line, match, away: Math.abs(dot(line, [...match, 1])) / Math.hypot(line[0], line[1]) };
  };
  const [on, off] = [WALL_POINTS.map(seen), BESIDE_POINTS.map(seen)],
    most = (list) => Math.max(...list.map(({ away }) => away));
  const epipole = pixelOf(applied(K, ASIDE.t));
  return { on, off, epipole, most: { on: most(on), off: most(off) } };
}

watch(["eu", "ev"], (values) => {
  const { on, off, epipole, most } = pencilNumbers(values),
    [svg, width] = fitted("pencil", 360),
    size = Math.min(width / 1300, 300 / 720);
  const toPlace = ([u, v]) => [width / 2 + size * (u - 320), 150 + size * (v - 240)];
  const [left, top] = toPlace([0, 0]);
  add(svg, "rect", { class: "frame", x: left, y: top, width: 640 * size, height: 480 * size });
  const e = [values.eu, values.ev];
  const thread = (through, kind) => {
    const along = unit(minus(through, e)),
      [a, b] = [-2500, 2500].map((s) => toPlace(plus(e, scaled(along, s))));
    add(svg, "line", { class: kind, x1: a[0], y1: a[1], x2: b[0], y2: b[1] });
  };
  const dots = (list, kind, r) =>
    list.forEach(({ match }) => {
      const [cx, cy] = toPlace(match);
      add(svg, "circle", { class: kind, cx, cy, r });
    });
  const foot = ({ line: [a, b, c], match: [u, v] }) => {
    const s = (a * u + b * v + c) / (a * a + b * b);
    return [u - s * a, v - s * b];
  };
  [...on, ...off].forEach((one) => thread(foot(one), on.includes(one) ? "thin" : "ray one"));
  off.forEach((one) => {
    const [a, b] = [one.match, foot(one)].map(toPlace);
    add(svg, "line", { class: "residual", x1: a[0], y1: a[1], x2: b[0], y2: b[1] });
  });
  dots(on, "other", 4.5);
  dots(off, "one", 6);
  const [cx, cy] = toPlace(epipole),
    [x, y] = toPlace(e);
  add(svg, "circle", { class: "behind", cx, cy, r: 9 });
  add(svg, "path", { class: "cross", d: `M${x - 8},${y} h16 M${x},${y - 8} v16` });
  const line = (text, at) => add(svg, "text", { class: "label", x: width / 2, y: at, "text-anchor": "middle" }, text);
  add(svg, "rect", { class: "floor", x: 0, y: 308, width, height: 52 });
  line(worded(WORDS.on_plane, { most: withUnit(most.on, WORDS.unit_px) }), 330);
  line(worded(WORDS.off_plane, { most: withUnit(most.off, WORDS.unit_px) }), 350);
  told("pencil-told", WORDS.pencil_told, most);
});
document.documentElement.dataset.ready = "yes";
