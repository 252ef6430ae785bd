/* The small figures of the page on scale: everything grows, an accelerometer sets meters, a scale that drifts. */

/* The house, its distance and the baseline grow together; what they were before stays as an outline. */
const GROWN = { tx: 1.6, yaw: -16 },
  grownBy = (k) => ({
    motion: motionOf({ ...GROWN, tx: k * GROWN.tx }),
    corners: SCENE.corners.map((corner) => scaled(corner, k)),
  });
const drawGrown = space("grow3d", { center: [0.8, -0.2, 4.6], distance: 17, yaw: -0.75, pitch: 0.32, zoom: 1.6 }, 330);

watch(["kg"], ({ kg }) => {
  const { motion, corners } = grownBy(kg),
    first = grownBy(1),
    center = inverseMotion(motion).t;
  drawGrown((put) => {
    putHouse(put, first.corners, SCENE.edges, "thin");
    putHouse(put, corners, SCENE.edges, "house strong");
    put.line([0, 0, 0], center, "edge");
    put.camera(HERE, "one", 0.9);
    put.camera(motion, "other", 0.9);
    put.line([0, 0, 0], corners[CORNER], "ray one");
    put.line(center, corners[CORNER], "ray other");
    put.dot(corners[CORNER], "object", 5);
  });
  const inside = insets("grow-images", [WORDS.first, WORDS.second]);
  const pixels = [HERE, motion].map((where, n) => {
    const pixel = project(moved(where, corners[CORNER]));
    insetHouse(inside[n], corners, SCENE.edges, where);
    insetMark(inside[n], pixel, ["one", "other"][n]);
    return pixel;
  });
  const width = norm(minus(corners[FRONT[0]], corners[FRONT[1]])),
    numbers = { kg, baseline: norm(center), width, u1: pixels[0][0], u2: pixels[1][0] };
  for (const name of ["baseline", "width"]) show(`grow-${name}`, numbers[name]);
  for (const name of ["u1", "u2"]) show(`grow-${name}`, numbers[name], WORDS.unit_px, 4);
  told("grow3d-told", WORDS.grow_told, numbers);
});

/* A camera with an accelerometer along a line, for 8 s: it starts, brakes and starts again. The images have its distance in
   units of an unknown length; the accelerometer, integrated twice, has it in meters. */
const RIDE = { seconds: 8, steps: 400, metersPerUnit: 1.7 },
  accelerationAt = (time) => 1.1 * Math.sin((2 * Math.PI * time) / 4) + 0.25;

/* Distances after each step by the trapezoidal rule, twice. */
function integratedTwice(acceleration) {
  const h = RIDE.seconds / RIDE.steps,
    out = [0];
  let speed = 0;
  for (let k = 0; k < RIDE.steps; k++) {
    const next = speed + 0.5 * h * (acceleration(k * h) + acceleration((k + 1) * h));
    out.push(out[k] + 0.5 * h * (speed + next));
    speed = next;
  }
  return out;
}

const IN_UNITS = integratedTwice(accelerationAt).map((meters) => meters / RIDE.metersPerUnit);

/* The scale that brings the distances of the images nearest to those of the accelerometer. */
function rideNumbers({ si, bias }) {
  const measured = integratedTwice((time) => accelerationAt(time) + bias);
  const rms = (s) => Math.sqrt(IN_UNITS.reduce((sum, u, k) => sum + (s * u - measured[k]) ** 2, 0) / measured.length);
  return { measured, rms: rms(si), best: dot(IN_UNITS, measured) / dot(IN_UNITS, IN_UNITS) };
}

watch(["si", "bias"], ({ si, bias }) => {
  const { measured, rms, best } = rideNumbers({ si, bias }),
    [svg, width] = fitted("ride", 260),
    box = { left: 40, top: 28, right: width - 16, bottom: 212 };
  const { toX, toY } = chartAxes(svg, box, [RIDE.seconds, 25], [WORDS.time_axis, WORDS.distance_axis]);
  const path = (values) =>
    "M" + values.map((y, k) => `${toX((RIDE.seconds * k) / RIDE.steps).toFixed(1)},${toY(y).toFixed(1)}`).join(" L");
  add(svg, "path", { class: "series warn", d: path(measured) });
  add(svg, "path", { class: "series accent", d: path(IN_UNITS.map((u) => si * u)) });
  add(svg, "text", { class: "label other", x: box.left + 14, y: box.top + 14 }, WORDS.accelerometer);
  add(svg, "text", { class: "label one", x: box.left + 14, y: box.top + 34 }, WORDS.images);
  show("ride-rms", rms, "m");
  show("ride-best", best);
  told("ride-told", WORDS.ride_told, { si, rms, best });
});

/* A loop of steps with equal angles; each step multiplies the scale by 1 + e. */
const LOOP = { steps: 48, length: 96 };

function driftedLoop(e) {
  const step = LOOP.length / LOOP.steps,
    path = [[0, 0]];
  for (let k = 0; k < LOOP.steps; k++) {
    const angle = (2 * Math.PI * (k + 0.5)) / LOOP.steps,
      length = step * (1 + e) ** k;
    path.push(plus(path[k], [length * Math.cos(angle), length * Math.sin(angle)]));
  }
  return { path, scale: (1 + e) ** LOOP.steps, gap: norm(path.at(-1)) };
}

watch(["ed"], ({ ed }) => {
  const { path, scale, gap } = driftedLoop(ed / 100),
    truth = driftedLoop(0).path,
    [svg, width] = fitted("drift", 330),
    size = 6.3;
  const toPlace = ([x, y]) => [width / 2 + size * x, 248 - size * y];
  const line = (points) => "M" + points.map((point) => toPlace(point).map((v) => v.toFixed(1))).join(" L");
  add(svg, "path", { class: "before", d: line(truth) });
  add(svg, "path", { class: "series accent", d: line(path) });
  path.forEach((point, k) => {
    const [cx, cy] = toPlace(point);
    if (k % 4 === 0) add(svg, "circle", { class: "one", cx, cy, r: 1.6 + 1.6 * (1 + ed / 100) ** k });
  });
  const [[x1, y1], [x2, y2]] = [toPlace(path[0]), toPlace(path.at(-1))];
  add(svg, "line", { class: "edge", x1, y1, x2, y2 });
  add(svg, "circle", { class: "object", cx: x1, cy: y1, r: 6 });
  add(svg, "text", { class: "label", x: x1 + 14, y: y1 + 18 }, WORDS.start);
  show("drift-scale", scale);
  show("drift-gap", (100 * gap) / LOOP.length, "%");
  told("drift-told", WORDS.drift_told, { e: ed, scale, gap: (100 * gap) / LOOP.length });
});
document.documentElement.dataset.ready = "yes";
