/* The small figures of the page on triangulation: rays that miss each other, reprojection errors, the ellipse and its angle. */

/* The second pixel is off the epipolar line: the two rays miss each other, and the point is halfway. */
const MISSED = [0.5, 0.1, 3.2];
const drawMissed = space("miss3d", { center: [0.75, 0.05, 1.75], distance: 8, yaw: -0.8, pitch: 0.4, zoom: 1.75 }, 340);

function missedRays({ Bm, em }) {
  const motion = motionOf({ tx: Bm, yaw: -14 }),
    pixels = [project(MISSED), plus(project(moved(motion, MISSED)), [0, em])];
  const [ray1, ray2] = pixels.map((pixel) => unit(rayOf(pixel))),
    center = inverseMotion(motion).t,
    way2 = applied(transposed(motion.R), ray2);
  const { point, along1, along2 } = triangulated(motion, ray1, ray2);
  const ends = [scaled(ray1, along1), plus(center, scaled(way2, along2))];
  return { motion, center, ways: [ray1, way2], ends, point, gap: norm(minus(...ends)) };
}

watch(["em", "Bm"], (values) => {
  const { motion, center, ways, ends, point, gap } = missedRays(values);
  drawMissed((put) => {
    put.line([0, 0, 0], center, "dashed");
    put.camera(HERE, "one", 0.7);
    put.camera(motion, "other", 0.7);
    putRay(put, [0, 0, 0], ways[0], "one", 4.1);
    putRay(put, center, ways[1], "other", 4.1);
    putImage(put, HERE, ways[0], "one", 0.7);
    putImage(put, motion, plus(center, ways[1]), "other", 0.7);
    put.line(...ends, "edge");
    put.dot(point, "object", 6);
    put.label(point, WORDS.midpoint, 10, 30);
    put.label([0, 0, 0], WORDS.first_camera, -64, 46);
    put.label(center, WORDS.second_camera, -20, 32);
  });
  const numbers = { gap, depth: point[2], off: norm(minus(point, MISSED)) };
  show("miss-gap", gap, "m");
  show("miss-depth", point[2], "m");
  show("miss-off", numbers.off, "m");
  told("miss3d-told", WORDS.miss_told, numbers);
});

/* A trial point, its projections, and the pixels that were observed: each image shows a part around its pixel. */
const TRIAL = { truth: [0.3, 0.2, 4], motions: [HERE, motionOf({ tx: 1.2, yaw: -14 })], window: 260 };
TRIAL.pixels = TRIAL.motions.map((motion, k) =>
  plus(project(moved(motion, TRIAL.truth)), scaled(SCENE.noise[5].slice(2 * k, 2 * k + 2), 9)),
);
TRIAL.best = refinedPoint(TRIAL.motions, TRIAL.pixels, TRIAL.truth);

watch(["Xr", "Yr", "Zr"], ({ Xr, Yr, Zr }) => {
  const point = [Xr, Yr, Zr],
    images = insets("reprojection", [WORDS.first, WORDS.second]);
  const off = TRIAL.motions.map((motion, k) => {
    const [inside, pixel, seen] = [images[k], TRIAL.pixels[k], project(moved(motion, point))];
    enlarge(inside, pixel, TRIAL.window);
    add(inside, "line", { class: "edge", x1: pixel[0], y1: pixel[1], x2: seen[0], y2: seen[1] });
    insetMark(inside, pixel, "cross truth", 7);
    insetMark(inside, seen, ["one", "other"][k], 5);
    return norm(minus(pixel, seen));
  });
  const numbers = {
    first: off[0],
    second: off[1],
    sum: off[0] ** 2 + off[1] ** 2,
    least: 4 * errorPx(TRIAL.motions, TRIAL.pixels, TRIAL.best) ** 2,
  };
  for (const name of ["first", "second"]) show(`trial-${name}`, numbers[name], WORDS.unit_px);
  for (const name of ["sum", "least"]) show(`trial-${name}`, numbers[name], `${WORDS.unit_px}²`);
  told("reprojection-told", WORDS.trial_told, numbers);
});

/* Two cameras at equal distances face a point under an angle; the noise of their pixels is enlarged in the drawing. */
const FACED = { distance: 6, enlarged: 30 };

function facingCameras(angle) {
  return [-0.5, 0.5].map((side) => {
    const turned = side * degrees(angle);
    return motionOf({
      tx: FACED.distance * Math.sin(turned),
      tz: FACED.distance * (1 - Math.cos(turned)),
      yaw: -side * angle,
    });
  });
}

function ellipseNumbers({ theta, sn }) {
  const motions = facingCameras(theta),
    covariance = covarianceOf(motions, [0, 0, FACED.distance], sn);
  const axes = eigenOf([0, 2].map((i) => [0, 2].map((k) => covariance[i][k]))),
    [short, long] = axes.values.map(Math.sqrt);
  return { motions, axes, short, long, ratio: long / short, law: 1 / Math.tan(degrees(theta) / 2) };
}

watch(["theta", "sn"], (values) => {
  const { motions, axes, ...numbers } = ellipseNumbers(values),
    [svg, width] = fitted("facing", 380),
    size = Math.min(34, (width / 2 - 24) / 5.4);
  const toPlace = ([x, , z]) => [width / 2 + size * x, 350 - size * (z - 0.1)],
    point = [0, 0, FACED.distance],
    half = (2 * values.sn * FACED.enlarged) / K[0][0];
  motions.forEach((motion, k) => {
    const back = inverseMotion(motion),
      at = (slope) => toPlace(moved(back, [slope * 14, 0, 14]));
    const kind = ["one", "other"][k];
    add(svg, "polygon", { class: `sheet ${kind}`, points: [toPlace(back.t), at(-half), at(half)].join(" ") });
    const [[x1, y1], [x2, y2]] = [toPlace(back.t), toPlace(point)];
    add(svg, "line", { class: "dashed", x1, y1, x2, y2 });
    drawCamera(svg, toPlace, motion, `${kind} filled`, 0.7);
  });
  drawEllipse(svg, axes, toPlace(point), size * FACED.enlarged, "spread");
  const [cx, cy] = toPlace(point);
  add(svg, "circle", { class: "object", cx, cy, r: 4.5 });
  add(svg, "text", { class: "label", x: 12, y: 22 }, `θ = ${withUnit(values.theta, "°")}`);
  add(svg, "text", { class: "label", x: 12, y: 42 }, WORDS.enlarged.replace("{times}", FACED.enlarged));
  for (const name of ["short", "long"]) show(`ellipse-${name}`, numbers[name], "m");
  for (const name of ["ratio", "law"]) show(`ellipse-${name}`, numbers[name]);
  told("facing-told", WORDS.facing_told, { ...values, ...numbers });
});
document.documentElement.dataset.ready = "yes";
