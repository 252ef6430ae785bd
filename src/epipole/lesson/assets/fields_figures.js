/* The small figures of the page on fields: fog along a ray, a Gaussian and its splat, two splats in both orders, costs. */

/* The recorded samples of the first pixel with the density multiplied by `times`, up to sample n. */
const FOG = RECORD.pixels[0].nerf;

function marchNumbers({ n, times }) {
  const pixel = { nerf: { ...FOG, thickness: FOG.thickness.map((v) => v * times) } };
  return composited("nerf", pixel, FOG.distance[Math.min(n, FOG.distance.length) - 1]);
}

watch(["n", "times"], (values) => {
  const most = marchNumbers({ ...values, n: FOG.distance.length }).parts.length; // there the ray ends
  byId("n").max = String(most);
  byId("n-shown").textContent = byId("n").value;
  const { parts, through, color } = marchNumbers(values),
    [svg, width] = fitted("fog", 300),
    box = { left: 84, right: width - 16, top: 40, bottom: 110 };
  const toX = (d) => box.left + ((box.right - box.left) * (d - RECORD.near)) / (RECORD.far - RECORD.near),
    toY = (t) => 232 - 84 * t;
  add(svg, "rect", { class: "swatch", x: 12, y: box.top, width: 56, height: 70, fill: cssColor(color) });
  add(svg, "text", { class: "label", x: 12, y: box.top - 10 }, WORDS.pixel);
  add(svg, "rect", { class: "white", x: box.left, y: box.top, width: box.right - box.left, height: 70 });
  const step = toX(FOG.distance[1]) - toX(FOG.distance[0]);
  parts.forEach(({ distance, weight, through: before, color: own }) => {
    const look = { x: toX(distance) - step / 2, width: step + 0.5, y: box.top, height: 70 };
    add(svg, "rect", { ...look, fill: cssColor(own), "fill-opacity": weight / before });
  });
  add(svg, "text", { class: "label", x: box.left, y: box.top - 10 }, WORDS.fog);
  for (const t of [0, 0.5, 1]) {
    add(svg, "line", { class: "grid", x1: box.left, x2: box.right, y1: toY(t), y2: toY(t) });
    add(svg, "text", { class: "tick", x: box.left - 7, y: toY(t) + 4, "text-anchor": "end" }, String(t));
  }
  add(svg, "text", { class: "label one", x: box.left, y: toY(1) - 10 }, WORDS.transmittance);
  const steps = parts.map((part) => `H${toX(part.distance)} V${toY(part.through)}`);
  const end = parts.length ? toX(parts.at(-1).distance) : box.left;
  add(svg, "path", { class: "ray one", d: `M${box.left},${toY(1)} ${steps.join(" ")} V${toY(through)} H${end + step}` });
  for (let x = Math.ceil(2 * RECORD.near) / 2; x <= RECORD.far; x += 0.5)
    add(svg, "text", { class: "tick", x: toX(x), y: 250, "text-anchor": "middle" }, x.toFixed(1));
  add(svg, "text", { class: "label", x: box.right, y: 268, "text-anchor": "end" }, WORDS.distance);
  const sum = { used: parts.length, through: shownNumber(through), weights: shownNumber(1 - through) };
  add(svg, "text", { class: "label", x: 12, y: 290 }, worded(WORDS.fog_sum, sum));
  told("fog-told", WORDS.fog_told, { used: parts.length, through }, ["used"]);
});

/* A Gaussian before the camera, and the ellipse that it is in the image: S = R diag(s^2) R^T and J S J^T. */
const NARROW = [0.16, 0.12];

function gaussianNumbers({ long, spin, far }) {
  const R = times(rotationOf([0, degrees(spin), 0]), rotationOf([0, 0, degrees(25)])),
    axes = transposed(R).map((axis, k) => scaled(axis, [long, ...NARROW][k])),
    mean = [0.5, -0.1, far];
  const covariance = [0, 1, 2].map((i) => [0, 1, 2].map((j) => axes.reduce((sum, a) => sum + a[i] * a[j], 0)));
  const [x, y, z] = mean,
    f = K[0][0],
    J = [
      [f / z, 0, (-f * x) / z ** 2],
      [0, f / z, (-f * y) / z ** 2],
    ];
  const seen = times(times(J, covariance), transposed(J));
  return { axes, mean, covariance, seen, ...eigenOf(seen) };
}

const SPLAT_AT = 1,
  drawGaussian = space("gaussian", { center: [0.25, -0.02, 1.35], distance: 4.5, yaw: -0.75, pitch: 0.35, zoom: 1.45 }, 340);
const around = (count) => Array.from({ length: count + 1 }, (_, k) => (2 * Math.PI * k) / count);

function putRing(put, points, kind) {
  points.slice(1).forEach((point, k) => put.line(points[k], point, kind));
}

watch(["long", "spin", "far"], (sliders) => {
  const { axes, mean, values, vectors } = gaussianNumbers(sliders),
    at = (x, y, z) => plus(mean, scaled(plus(plus(scaled(axes[0], x), scaled(axes[1], y)), scaled(axes[2], z)), 2));
  drawGaussian((put) => {
    put.camera(HERE, "other", SPLAT_AT);
    for (const h of [-0.6, 0, 0.6]) {
      const r = Math.sqrt(1 - h * h);
      putRing(put, around(24).map((a) => at(h, r * Math.cos(a), r * Math.sin(a))), "wire one");
    }
    for (const b of [0, Math.PI / 4, Math.PI / 2, (3 * Math.PI) / 4])
      putRing(put, around(24).map((a) => at(Math.cos(a), Math.sin(a) * Math.cos(b), Math.sin(a) * Math.sin(b))), "wire one");
    const rim = around(32).map((a) => {
      const [long, short] = [1, 0].map((k) => 2 * Math.sqrt(values[k])),
        pixel = plus(project(mean), plus(scaled(vectors[1], long * Math.cos(a)), scaled(vectors[0], short * Math.sin(a))));
      return scaled(rayOf(pixel), SPLAT_AT);
    });
    put.area(rim, "sheet other");
    putRing(put, rim, "wire other");
    put.line([0, 0, 0], mean, "dashed");
    put.dot(mean, "one", 4);
    put.label(plus(mean, [0, -0.3 - 0.45 * sliders.long, 0]), WORDS.gaussian, -24, 0);
    put.label([0, 0, 0], WORDS.camera, -10, 22);
  });
  show("sd_long", Math.sqrt(values[1]), WORDS.unit_px);
  show("sd_short", Math.sqrt(values[0]), WORDS.unit_px);
  told("gaussian-told", WORDS.gaussian_told, { long: Math.sqrt(values[1]), short: Math.sqrt(values[0]) });
});

/* Two splats over white, front to back. */
const INKS = { red: [0.85, 0.15, 0.12], blue: [0.1, 0.3, 0.85] };
let front = "red";

function overlaid(alphas) {
  const over = (one, other) =>
    INKS[one].map((v, k) => {
      const through = 1 - alphas[one];
      return alphas[one] * v + through * (alphas[other] * INKS[other][k] + (1 - alphas[other]));
    });
  return { red: over("red", "blue"), blue: over("blue", "red") };
}

function drawOrder({ red, blue }) {
  const [svg, width] = fitted("order", 268),
    alphas = { red, blue },
    both = overlaid(alphas),
    back = front === "red" ? "blue" : "red";
  const wide = Math.min(480, width - 140),
    middle = 12 + wide / 2;
  add(svg, "rect", { class: "white", x: 12, y: 12, width: wide, height: 200 });
  const place = { red: middle - 0.14 * wide, blue: middle + 0.14 * wide };
  for (const name of [back, front])
    add(svg, "ellipse", { cx: place[name], cy: 112, rx: 0.3 * wide, ry: 78, fill: cssColor(INKS[name]), "fill-opacity": alphas[name] });
  ["red", "blue"].forEach((name, k) => {
    const y = 32 + 104 * k,
      isShown = name === front;
    add(svg, "rect", { class: "swatch", x: wide + 28, y, width: 84, height: 60, fill: cssColor(both[name]) });
    const label = add(svg, "text", { class: `label ${isShown ? "strong" : ""}`, x: wide + 28, y: y - 8 }, WORDS.in_front[name]);
    if (isShown) label.setAttribute("font-weight", "600");
  });
  const shown = both[front].map((v) => shownNumber(v, 2)).join(", ");
  add(svg, "text", { class: "label", x: 12, y: 246 }, worded(WORDS.overlap, { color: shown }));
  const [r, g, b] = both[front];
  told("order-told", WORDS.order_told, { r, g, b });
}

const setOrder = watch(["red", "blue"], drawOrder);
byId("swap").addEventListener("click", () => {
  front = front === "red" ? "blue" : "red";
  setOrder({});
  sayWhenStill(byId("swap"));
});

/* Operations of an image: the layers of the network of NeRF (Mildenhall et al. 2020, figure 7), and a pair as the library counts. */
const LAYERS = [[63, 256], [256, 256], [256, 256], [256, 256], [256, 256], [319, 256], [256, 256], [256, 256], [256, 257], [283, 128], [128, 3]],
  PER_QUERY = 2 * LAYERS.reduce((sum, [given, made]) => sum + given * made, 0),
  PIXELS = 800 * 800,
  SPEED = 1e13;

function costNumbers({ queries, pairs }) {
  const nerf = queries * PER_QUERY * PIXELS,
    splat = pairs * RECORD.operations.pair * PIXELS;
  return { nerf, splat, images: { nerf: SPEED / nerf, splat: SPEED / splat } };
}

watch(["queries", "pairs"], (values) => {
  const found = costNumbers(values),
    [svg, width] = fitted("costs", 250),
    box = { left: 12, right: width - 16 },
    [least, most] = [6, 16];
  const toX = (value) => box.left + ((box.right - box.left) * (Math.log10(value) - least)) / (most - least);
  for (let power = least; power <= most; power += 2) {
    const x = toX(10 ** power);
    add(svg, "line", { class: "grid", x1: x, x2: x, y1: 12, y2: 184 });
    const anchor = power === least ? "start" : power === most ? "end" : "middle";
    add(svg, "text", { class: "tick", x, y: 202, "text-anchor": anchor }, shownNumber(10 ** power, 1).replace("1 × ", ""));
  }
  add(svg, "text", { class: "label", x: box.right, y: 224, "text-anchor": "end" }, WORDS.operations);
  [["nerf", "other"], ["splat", "one"]].forEach(([way, kind], k) => {
    const y = 20 + 84 * k;
    add(svg, "rect", { class: `filled-${kind}`, x: box.left, y: y + 30, width: toX(found[way]) - box.left, height: 24 });
    const given = { work: shownNumber(found[way]), images: shownNumber(found.images[way], 2) };
    add(svg, "text", { class: `label ${kind}`, x: box.left, y: y + 18 }, worded(WORDS.cost[way], given));
  });
  told("costs-told", WORDS.costs_told, { nerf: found.nerf, splat: found.splat });
});
document.documentElement.dataset.ready = "yes";
