/* One pixel marched through a neural field, and the same pixel splatted; both from what training left. */
const RECORD = JSON.parse(byId("scene").textContent);
const WAYS = ["nerf", "splat"];

/* Samples of a ray: alpha = 1 - exp(-sigma delta); what is behind `least` of the light is not asked for (NeRF, Mildenhall et al. 2020, eq. 3). */
function samplesOf({ nerf }) {
  return nerf.distance.map((distance, k) => ({
    distance,
    alpha: -Math.expm1(-nerf.thickness[k]),
    color: nerf.color[k],
  }));
}

/* Gaussians of a pixel: alpha = o exp(-d' A d / 2), at most 0.99; below 1/255 it changes nothing (Kerbl et al. 2023). */
function gaussiansOf({ splat }) {
  return splat.distance.map((distance, k) => ({
    distance,
    alpha: Math.min(splat.opacity[k] * Math.exp(splat.power[k]), RECORD.largest_alpha),
    color: splat.color[k],
  }));
}

const MARCHED = { nerf: samplesOf, splat: gaussiansOf },
  OVER = { nerf: RECORD.over_nerf, splat: RECORD.over },
  LEAST = { nerf: 0, splat: RECORD.least_alpha };

/* Front to back: sum of T_i alpha_i c_i with T_i = prod_{j<i} (1 - alpha_j), over white, as far as `upto`. */
function composited(way, pixel, upto) {
  let through = 1;
  const color = [0, 0, 0],
    parts = [];
  for (const { distance, alpha, color: own } of MARCHED[way](pixel)) {
    if (distance > upto || through <= OVER[way]) break;
    if (alpha < LEAST[way]) continue;
    const weight = through * alpha;
    own.forEach((v, k) => (color[k] += weight * v));
    parts.push({ distance, weight, through, color: own });
    through *= 1 - alpha;
  }
  const weights = parts.reduce((sum, { weight }) => sum + weight, 0),
    depth = parts.reduce((sum, { weight, distance }) => sum + weight * distance, 0) / weights;
  return { parts, through, weights, depth, color: color.map((v) => v + through) };
}

const cssColor = (color) =>
  `rgb(${color.map((v) => Math.round(255 * Math.min(1, Math.max(0, v)))).join(" ")})`;

function fieldNumbers({ upto }, name) {
  const pixel = RECORD.pixels[Number(name)],
    numbers = {},
    found = {};
  for (const way of WAYS) {
    const { parts, through, weights, depth, color } = (found[way] = composited(way, pixel, upto));
    Object.assign(numbers, {
      [`used-${way}`]: parts.length,
      [`weights-${way}`]: weights,
      [`through-${way}`]: through,
      [`depth-${way}`]: depth,
      [`red-${way}`]: color[0],
      [`green-${way}`]: color[1],
      [`blue-${way}`]: color[2],
    });
  }
  return { pixel, found, numbers };
}

/* The view by both, and as it is; a ring is the pixel that is looked into. */
function drawPictures(chosenPixel) {
  const svg = clear("pictures"),
    side = RECORD.side;
  svg.setAttribute("viewBox", `0 0 ${3 * side + 20} ${side + 26}`);
  const shown = [["truth", RECORD.truth], ...WAYS.map((way) => [way, RECORD.pictures[way]])];
  shown.forEach(([name, data], k) => {
    const left = k * (side + 10);
    const label = add(svg, "text", { class: "label", x: left + 6, y: 17 }, WORDS.pictures[name]);
    label.style.fontSize = `${Math.min(20, (13 * (3 * side + 20)) / (svg.clientWidth || 620))}px`; // as large as elsewhere
    add(svg, "image", { href: "data:image/webp;base64," + data, x: left, y: 24, width: side, height: side });
    RECORD.pixels.forEach(({ at: [x, y] }, which) => {
      const kind = String(which) === chosenPixel ? "ring chosen" : "ring";
      add(svg, "circle", {
        class: kind,
        cx: left + x + 0.5,
        cy: 24.5 + y,
        r: String(which) === chosenPixel ? 7 : 4,
      });
    });
  });
}

/* Along the ray: what each part adds, in its own color, and what is still let through before it. */
function drawRay(way, { parts, through }, upto) {
  const [svg, width] = fitted(`ray-${way}`, 220),
    box = { left: 44, top: 30, right: width - 14, bottom: 172 };
  const toX = (distance) =>
      box.left + ((box.right - box.left) * (distance - RECORD.near)) / (RECORD.far - RECORD.near),
    toY = (v) => box.bottom - (box.bottom - box.top) * v;
  for (const y of [0, 0.5, 1]) {
    add(svg, "line", { class: "grid", x1: box.left, x2: box.right, y1: toY(y), y2: toY(y) });
    add(svg, "text", { class: "tick", x: box.left - 7, y: toY(y) + 4, "text-anchor": "end" }, String(y));
  }
  for (let x = Math.ceil(2 * RECORD.near) / 2; x <= RECORD.far; x += 0.5)
    add(svg, "text", { class: "tick", x: toX(x), y: box.bottom + 24, "text-anchor": "middle" }, x.toFixed(1));
  add(
    svg,
    "text",
    { class: "label", x: box.right, y: box.bottom + 42, "text-anchor": "end" },
    WORDS.distance,
  );
  add(svg, "text", { class: "label", x: 8, y: 16 }, WORDS.ways[way]);
  for (const { distance, weight, color } of parts) {
    add(svg, "line", {
      class: "query",
      x1: toX(distance),
      x2: toX(distance),
      y1: box.bottom + 2,
      y2: box.bottom + 8,
    });
    const top = toY(weight);
    add(svg, "rect", {
      class: "weight",
      x: toX(distance) - 2,
      width: 4,
      y: top,
      height: toY(0) - top,
      fill: cssColor(color),
    });
  }
  const steps = parts.map((part) => `H${toX(part.distance)} V${toY(part.through)}`);
  const end = Math.min(upto, RECORD.far);
  add(svg, "path", {
    class: "ray one",
    d: `M${toX(RECORD.near)},${toY(1)} ${steps.join(" ")} V${toY(through)} H${toX(end)}`,
  });
  add(svg, "line", { class: "measure", x1: toX(end), x2: toX(end), y1: box.top, y2: box.bottom });
}

function drawColors({ pixel, found }) {
  const inRow = (width) => (width < 600 ? 2 : 4),
    [svg, width] = fitted("colors", (all) => (all < 600 ? 148 : 74)),
    part = (width - 20) / inRow(width);
  const shown = WAYS.flatMap((way) => [
    [WORDS.colors.summed[way], found[way].color],
    [WORDS.colors.drawn[way], pixel.drawn[way]],
  ]);
  shown.forEach(([name, color], k) => {
    const x = 6 + (k % inRow(width)) * (part + 2),
      y = 4 + 72 * Math.floor(k / inRow(width));
    add(svg, "rect", { class: "swatch", x, y, width: part, height: 36, fill: cssColor(color) });
    add(svg, "text", { class: "tick", x, y: y + 54 }, name);
  });
}

const set = watch(["upto"], (values) => {
  const name = chosen("pixel"),
    { pixel, found, numbers } = fieldNumbers(values, name);
  for (const [id, value] of Object.entries(numbers))
    if (id.startsWith("used")) showCount(id, value);
    else show(id, value, id.startsWith("depth") ? "m" : "");
  drawPictures(name);
  for (const way of WAYS) {
    drawRay(way, found[way], values.upto);
    const [used, depth, through] = ["used", "depth", "through"].map((name) => numbers[`${name}-${way}`]);
    told(`ray-${way}-told`, WORDS.ray_told, { used, depth, through }, ["used"]);
  }
  drawColors({ pixel, found });
});

byId("pictures").addEventListener("click", (event) => {
  const [x, y] = place(byId("pictures"), event),
    column = x % (RECORD.side + 10);
  const away = RECORD.pixels.map(({ at }) => Math.hypot(at[0] - column, at[1] + 24 - y));
  document.querySelector(`input[name=pixel][value="${away.indexOf(Math.min(...away))}"]`).checked = true;
  set({});
});
for (const [way, row] of Object.entries(RECORD.rows))
  for (const [name, unit] of [
    ["psnr", "dB"],
    ["frames_s", ""],
    ["train_s", "s"],
  ])
    show(`${name}-${way}`, row[name], unit, 3);
show("queries-nerf", RECORD.rows.nerf.queries, "", 3);
show("evaluated-splat", RECORD.rows.splat.evaluated, "", 3);
show("useful-splat", RECORD.rows.splat.useful, "", 3);
show("operations-nerf", RECORD.rows.nerf.queries * RECORD.operations.query, "", 3);
show("operations-splat", RECORD.rows.splat.evaluated * RECORD.operations.pair, "", 3);
show("faster", RECORD.rows.splat.frames_s / RECORD.rows.nerf.frames_s, "", 3);
