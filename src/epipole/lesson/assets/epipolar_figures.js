/* The small figures of the page on epipolar geometry: the epipolar plane, a point on a line, three vectors in a plane. */

/* The epipolar plane: both centers and the point span it, and it cuts each image plane in a line. */
const SECOND = motionOf({ tx: 1.6, yaw: -18 }),
  PLANE_AT = 0.9,
  RAY = [0.32, 0.22, 1];
const inPlane = ([x, y, z], { R, t }) => moved(inverseMotion({ R, t }), [(PLANE_AT * x) / z, (PLANE_AT * y) / z, PLANE_AT]);
const drawPlane = space("plane3d", { center: [0.9, 0.1, 1.5], distance: 6, yaw: -0.5, pitch: 0.4, zoom: 1.5 }, 340);

watch(["Zp"], ({ Zp }) => {
  const center2 = inverseMotion(SECOND).t,
    point = scaled(RAY, Zp),
    [image1, image2] = [inPlane(point, HERE), inPlane(moved(SECOND, point), SECOND)];
  const ends = [0.9, 30].map((z) => inPlane(moved(SECOND, scaled(RAY, z)), SECOND));
  drawPlane((put) => {
    put.area([[0, 0, 0], center2, scaled(RAY, 5)], "sheet");
    put.line([0, 0, 0], center2, "edge");
    put.camera(HERE, "one", PLANE_AT);
    put.camera(SECOND, "other", PLANE_AT);
    put.line([0, 0, 0], scaled(RAY, 5), "ray one");
    put.line(center2, point, "ray other");
    put.line(...ends, "edge");
    for (const z of [1.5, 2, 3, 4]) put.dot(inPlane(moved(SECOND, scaled(RAY, z)), SECOND), "behind", 3);
    put.dot(point, "object", 7);
    put.dot(image1, "one", 5);
    put.dot(image2, "other", 5);
    put.label(point, WORDS.point, 12, -6);
    put.label([0, 0, 0], WORDS.first_camera, -6, 22);
    put.label(center2, WORDS.second_camera, -30, 22);
  });
  told("plane3d-told", WORDS.plane_told, { Z: Zp });
});

/* A line (a, b, c) and a pixel: the product is zero where the pixel lies on the line. */
const LINE = { u: 150, v: 150 };
const setLine = watch(["tilt", "push"], ({ tilt, push }) => {
  const [svg, width] = fitted("online", 300),
    angle = degrees(tilt);
  const [a, b] = [-Math.sin(angle), Math.cos(angle)],
    c = -(a * 320 + b * 150) - push,
    pixel = [LINE.u, LINE.v],
    value = a * pixel[0] + b * pixel[1] + c;
  const shift = (width - 640) / 2,
    foot = minus(pixel, scaled([a, b], value)),
    inside = add(svg, "g", { transform: `translate(${shift} 0)` });
  const along = (s) => [foot[0] + s * b, foot[1] - s * a];
  const [from, to] = [along(-2000), along(2000)];
  add(inside, "line", { class: "ray other", x1: from[0], y1: from[1], x2: to[0], y2: to[1] });
  add(inside, "line", { class: "residual", x1: pixel[0], y1: pixel[1], x2: foot[0], y2: foot[1] });
  add(inside, "circle", { class: "one", cx: pixel[0], cy: pixel[1], r: 8 });
  add(inside, "circle", { class: "grip handle", cx: pixel[0], cy: pixel[1], r: 26 });
  const whole = (v) => shownNumber(v, 3);
  add(svg, "text", { class: "label one", x: 12, y: 22 }, `x = (${whole(pixel[0])}, ${whole(pixel[1])}, 1)`);
  add(svg, "text", { class: "label other", x: 12, y: 42 }, `l = (${whole(a)}, ${whole(b)}, ${whole(c)})`);
  const side = Math.abs(value) < 0.5 ? WORDS.on_line : value > 0 ? WORDS.below_line : WORDS.above_line;
  add(svg, "text", { class: "label", x: 12, y: 62 }, `l · x = ${whole(value)} ${WORDS.unit_px || "px"}: ${side}`);
  told("online-told", WORDS.online_told, { u: pixel[0], v: pixel[1], value });
});
drag(byId("online"), (x, y) => {
  const width = byId("online").viewBox.baseVal.width;
  LINE.u = Math.min(630, Math.max(10, x - (width - 640) / 2));
  LINE.v = Math.min(290, Math.max(76, y));
  setLine({});
});

/* The box that both rays and the baseline span: flat for a correspondence. */
const drawBox = space("box3d", { center: [0.5, 0.25, 1], distance: 5.2, yaw: -0.5, pitch: 0.5, zoom: 1.3 }, 320);

watch(["lift"], ({ lift }) => {
  const t = scaled(inverseMotion(SECOND).t, 0.8),
    first = scaled(unit(RAY), 1.5),
    flat = minus(scaled(first, 1.15), t);
  const other = plus(flat, scaled(unit(cross(t, first)), lift)),
    volume = dot(other, cross(t, first));
  drawBox((put) => {
    const corner = (i, j, k) => plus(plus(scaled(t, i), scaled(first, j)), scaled(other, k));
    const faces = [[t, first], [t, other], [first, other]];
    faces.forEach(([a, b], k) => {
      for (const start of [[0, 0, 0], [other, first, t][k]])
        put.area([start, plus(start, a), plus(plus(start, a), b), plus(start, b)], "sheet");
    });
    for (const [i, j] of [[0, 0], [0, 1], [1, 0], [1, 1]]) {
      put.line(corner(0, i, j), corner(1, i, j), "house");
      put.line(corner(i, 0, j), corner(i, 1, j), "house");
      put.line(corner(i, j, 0), corner(i, j, 1), "house");
    }
    put.line([0, 0, 0], t, "thin-arrow edge");
    put.line([0, 0, 0], first, "arrow one");
    put.line([0, 0, 0], other, "arrow other");
    put.label(t, "t", 4, 18);
    put.label(first, "R x̂", 8, 14);
    put.label(other, "x̂′", -8, -10);
  });
  show("volume", volume, "", 3);
  told("box3d-told", WORDS.box_told, { volume });
});
document.documentElement.dataset.ready = "yes";
