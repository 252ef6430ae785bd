/* The small figures of the page on candidates: the sign of t, the twisted pair, four pairs of cameras, wrong votes. */

/* Two cameras with a long baseline, and the rays of one point. */
const TWO = motionOf({ tx: 1.8, tz: 1.2, yaw: -30 }),
  CENTER2 = inverseMotion(TWO).t,
  SEEN_POINT = [0.1, 0.35, 3.6],
  TO_POINT = minus(SEEN_POINT, CENTER2),
  RAY2 = moved(TWO, SEEN_POINT);
const tripleOf = (motion, ray1, ray2) => dot(unit(ray2), applied(times(skew(motion.t), motion.R), unit(ray1)));

/* The second camera moves along the baseline: its pixel stays, and so does the plane; the two rays meet elsewhere. */
const drawSign = space("sign3d", { center: [0, 0.15, 0], distance: 11.5, yaw: -1.0, pitch: 0.62, zoom: 1.7 }, 360);

watch(["bs"], ({ bs }) => {
  const motion = { R: TWO.R, t: scaled(TWO.t, bs) },
    center = scaled(CENTER2, bs),
    { point } = triangulated(motion, SEEN_POINT, RAY2);
  const inPlane = (along, up) => plus(scaled(CENTER2, along), scaled(SEEN_POINT, up));
  drawSign((put) => {
    put.area([inPlane(-1.15, -0.8), inPlane(1.15, -0.8), inPlane(1.15, 0.8), inPlane(-1.15, 0.8)], "sheet");
    put.line(scaled(CENTER2, -1.3), scaled(CENTER2, 1.3), "edge");
    putRay(put, [0, 0, 0], SEEN_POINT, "one", 1.15, 1.15);
    putRay(put, center, TO_POINT, "other", 1.15, 1.15);
    put.camera(HERE, "one", 0.7);
    put.camera(motion, "other", 0.7);
    put.dot(point, "object", 7);
    put.label(point, WORDS.point, 12, 5);
    put.label([0, 0, 0], WORDS.first_camera, ...(bs < 0 ? [12, 22] : [-40, 42]));
    if (Math.abs(bs) > 0.6) put.label(center, WORDS.second_camera, -20, 28);
  });
  const numbers = { bs, z1: point[2], z2: moved(motion, point)[2], triple: tripleOf(motion, SEEN_POINT, RAY2) };
  show("sign-z1", numbers.z1, "m");
  show("sign-z2", numbers.z2, "m");
  show("sign-triple", numbers.triple);
  told("sign3d-told", WORDS.sign_told, numbers);
});

/* The second camera rotates about the baseline: world_from_cam2 is rotated from the left. */
function twisted(angle) {
  const about = rotationOf(scaled(unit(CENTER2), degrees(angle))),
    R = times(TWO.R, transposed(about));
  return { about, motion: { R, t: scaled(applied(R, CENTER2), -1) } };
}

const flatE = ({ R, t }) => times(skew(t), R).flat();
const drawTwist = space("twist3d", { center: [0.6, -0.25, 0.9], distance: 11, yaw: -0.75, pitch: 0.4, zoom: 1.7 }, 350);

watch(["twist"], ({ twist }) => {
  const { about, motion } = twisted(twist),
    way = applied(about, TO_POINT),
    triple = tripleOf(motion, SEEN_POINT, RAY2),
    cosine = dot(unit(flatE(motion)), unit(flatE(TWO)));
  drawTwist((put) => {
    put.area([[0, 0, 0], CENTER2, plus(CENTER2, scaled(SEEN_POINT, 1.05)), scaled(SEEN_POINT, 1.05)], "sheet");
    put.area([CENTER2, plus(CENTER2, scaled(way, 0.6)), scaled(way, 0.6), [0, 0, 0]], "sheet other");
    put.line(scaled(CENTER2, -0.25), scaled(CENTER2, 1.35), "edge");
    putRay(put, [0, 0, 0], SEEN_POINT, "one", 1.15, 0.3);
    putRay(put, CENTER2, way, "other", 1.02, 0.9);
    put.camera(HERE, "one", 0.7);
    put.camera(motion, "other", 0.7);
    if (Math.abs(triple) < 1e-3) {
      const { point } = triangulated(motion, SEEN_POINT, RAY2);
      put.dot(point, "object", 7);
      put.label(point, WORDS.point, 12, 5);
    }
    put.label([0, 0, 0], WORDS.first_camera, -36, 40);
    put.label(scaled(CENTER2, 1.35), WORDS.baseline, 8, 5);
  });
  show("twist-triple", triple);
  show("twist-cosine", cosine);
  told("twist3d-told", WORDS.twist_told, { twist, triple, cosine });
});

/* The house as each candidate triangulates it. */
const HOUSE_CENTER = scaled(SCENE.corners.reduce(plus), 1 / SCENE.corners.length),
  HOUSE_RAYS = SCENE.corners.map((corner) => {
    const point = plus(HOUSE_CENTER, scaled(minus(corner, HOUSE_CENTER), 0.6));
    return [point, moved(TWO, point)];
  }),
  CANDIDATES = candidatesOf(times(skew(TWO.t), TWO.R)).map(({ R, t }) => ({ R, t: scaled(t, norm(TWO.t)) })),
  SHOWN_CORNERS = [1, 3, 8];
const drawFourth = space("four3d", { center: [0.2, 0.1, 0.3], distance: 19, yaw: -1.05, pitch: 0.42, zoom: 1.7 }, 330);

watch([], () => {
  const which = "ABCD".indexOf(chosen("pair")),
    motion = CANDIDATES[which],
    back = inverseMotion(motion);
  const found = HOUSE_RAYS.map(([ray1, ray2]) => triangulated(motion, ray1, ray2)),
    corners = found.map(({ point }) => point);
  const count = corners.filter((point) => point[2] > 0 && moved(motion, point)[2] > 0).length;
  drawFourth((put) => {
    putHouse(put, corners, SCENE.edges, "house strong");
    SHOWN_CORNERS.forEach((k) => {
      const { along1, along2, point } = found[k];
      put.line([0, 0, 0], point, along1 > 0 ? "ray one" : "dashed one");
      put.line(back.t, point, along2 > 0 ? "ray other" : "dashed other");
      put.dot(point, along1 > 0 && along2 > 0 ? "object" : "behind", 5);
    });
    put.line([0, 0, 0], back.t, "edge");
    put.camera(HERE, "one", 0.9);
    put.camera(motion, "other", 0.9);
  });
  const numbers = { z1: corners[1][2], z2: moved(motion, corners[1])[2], count };
  show("four-z1", numbers.z1, "m");
  show("four-z2", numbers.z2, "m");
  showCount("four-count", count);
  told("four3d-told", WORDS.four3d_told, { ...numbers, all: corners.length }, ["count", "all"]);
});

/* The part of a normal distribution above this many standard deviations (Simpson's rule). */
function upperTail(start) {
  const [steps, end] = [4000, Math.max(start, 0) + 12],
    h = (end - start) / steps;
  const value = (x) => Math.exp(-0.5 * x * x) / Math.sqrt(2 * Math.PI);
  const weight = (k) => (k === 0 || k === steps ? 1 : k % 2 ? 4 : 2);
  return (h / 3) * Array.from({ length: steps + 1 }, (_, k) => weight(k) * value(start + k * h)).reduce((a, b) => a + b);
}

/* A disparity with noise in both pixels: where it is negative, the rays meet behind the cameras. */
const BELL = { least: -8, most: 28 };

watch(["Zv", "Bv", "sv"], ({ Zv, Bv, sv }) => {
  const [svg, width] = fitted("bell", 250),
    [bottom, top] = [200, 44],
    d = (K[0][0] * Bv) / Zv,
    spread = Math.SQRT2 * sv,
    wrong = upperTail(d / spread);
  const toX = (x) => 14 + ((width - 28) * (x - BELL.least)) / (BELL.most - BELL.least);
  const toY = (x) => bottom - (bottom - top) * Math.exp(-0.5 * ((x - d) / spread) ** 2);
  const curve = (from, to) =>
    Array.from({ length: 241 }, (_, k) => from + ((to - from) * k) / 240)
      .map((x) => `${toX(x).toFixed(1)},${toY(x).toFixed(1)}`)
      .join(" L");
  add(svg, "path", { class: "band", d: `M${toX(BELL.least)},${bottom} L${curve(BELL.least, 0)} V${bottom} Z` });
  add(svg, "path", { class: "series accent", d: `M${curve(BELL.least, BELL.most)}` });
  add(svg, "path", { class: "axis", d: `M14,${bottom} H${width - 14}` });
  add(svg, "line", { class: "dashed", x1: toX(0), x2: toX(0), y1: top - 10, y2: bottom });
  for (let x = -5; x <= 25; x += 5)
    add(svg, "text", { class: "tick", x: toX(x), y: bottom + 16, "text-anchor": "middle" }, String(x).replace("-", "−"));
  add(svg, "text", { class: "label", x: width - 14, y: bottom + 38, "text-anchor": "end" }, WORDS.disparity_axis);
  add(svg, "text", { class: "label other", x: toX(0) - 8, y: top - 20, "text-anchor": "end" }, WORDS.behind);
  add(svg, "text", { class: "label one", x: toX(0) + 8, y: top - 20 }, WORDS.ahead);
  show("bell-d", d, WORDS.unit_px);
  show("bell-wrong", 100 * wrong, "%");
  told("bell-told", WORDS.bell_told, { Z: Zv, d, wrong: 100 * wrong });
});
document.documentElement.dataset.ready = "yes";
