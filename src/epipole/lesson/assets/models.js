/* Which model says most of the matches with what it needs: Torr's criterion (PhilTrans A 1998, eq. 12). */
const DIMENSION = { F: 3, E: 3, H: 2, R: 2, S: 2 },
  PARAMETERS = { F: 7, E: 5, H: 8, R: 3, S: 0 };

function criterionOf(name, distances, sigma) {
  const n = distances.length,
    d = DIMENSION[name],
    most = 2 * (4 - d);
  const rest = distances.reduce((sum, e) => sum + Math.min((e * e) / (sigma * sigma), most), 0);
  return rest + n * d * Math.log(4) + PARAMETERS[name] * Math.log(4 * n);
}

/* A leaning wall with points before and behind it, seen twice. */
function matchesOf({ relief, tx, yaw, s }) {
  const motion = motionOf({ tx, yaw });
  const points = SCENE.corners.map(([x, y, deep]) => [x, y, 6 + 0.3 * x - 0.2 * y + relief * deep]);
  const pixels = [HERE, motion].map((where, k) =>
    points.map((point, j) => plus(project(moved(where, point)), scaled(SCENE.noise[k][j], s))),
  );
  return { motion, pixels };
}

function modelNumbers(values) {
  const { motion, pixels } = matchesOf(values),
    [one, two] = pixels,
    rays = pixels.map((each) => each.map((pixel) => unit(rayOf(pixel))));
  const models = {
    F: fundamentalFrom(one, two),
    E: essentialFrom(one, two, motion),
    H: homographyFrom(one, two),
    R: times(times(K, rotationFrom(...rays)), K_INVERSE),
    S: HERE.R,
  };
  const found = {};
  for (const [name, model] of Object.entries(models)) {
    const distance = DIMENSION[name] === 3 ? sampsonOf : transferOf;
    const distances = one.map((pixel, k) => distance(model, pixel, two[k]));
    found[name] = {
      model,
      rms: Math.sqrt(dot(distances, distances) / distances.length),
      gric: criterionOf(name, distances, values.s),
    };
  }
  const names = Object.keys(found);
  return { pixels, found, best: names.reduce((a, b) => (found[b].gric < found[a].gric ? b : a)) };
}

/* From where the model expects a match to where it is. */
function expected(name, model, pixel, match) {
  if (DIMENSION[name] === 2) return pixelOf(applied(model, [...pixel, 1]));
  const line = applied(model, [...pixel, 1]),
    size = Math.hypot(line[0], line[1]),
    away = dot(line, [...match, 1]) / size;
  return minus(match, [(away * line[0]) / size, (away * line[1]) / size]);
}

/* Marks that can be seen in a small picture, too. */
const markSize = (inside) => Math.max(4.5, (2 * 640) / Number(inside.getAttribute("width")));

function drawPictures({ pixels, found }, name) {
  const [first, second] = twoPictures("pictures", [WORDS.first, WORDS.second]);
  pixels[0].forEach(([x, y]) => add(first, "circle", { class: "one", cx: x, cy: y, r: markSize(first) }));
  pixels[1].forEach((match, k) => {
    const from = expected(name, found[name].model, pixels[0][k], match),
      to = plus(from, scaled(minus(match, from), 10));
    add(second, "line", { class: "residual", x1: from[0], y1: from[1], x2: to[0], y2: to[1] });
    add(second, "circle", { class: "other", cx: match[0], cy: match[1], r: markSize(second) });
  });
}

/* The slider has the root of the relief: what decides between the models is far below its largest value. */
function setRelief(root) {
  byId("relief").value = String(root * root);
  byId("relief").dispatchEvent(new Event("input"));
}
const ROOT = byId("relief-root");
let rootBefore = ROOT.value;
ROOT.addEventListener("input", () => setRelief(Number(ROOT.value)));
ROOT.addEventListener("pointerdown", () => (rootBefore = ROOT.value));
ROOT.addEventListener("pointercancel", () => setRelief(Number(rootBefore))); // the finger scrolled the page

watch(["relief", "tx", "yaw", "s"], (values) => {
  ROOT.value = String(Math.sqrt(values.relief));
  ROOT.setAttribute("aria-valuetext", byId("relief-shown").textContent);
  const { pixels, found, best } = modelNumbers(values);
  for (const [name, { rms, gric }] of Object.entries(found)) {
    show(`rms-${name}`, rms);
    show(`gric-${name}`, gric, "", 4);
    byId(`verdict-${name}`).textContent = name === best ? WORDS.chosen : "";
    byId(`row-${name}`).className = name === best ? "best" : "";
  }
  drawPictures({ pixels, found }, chosen("model"));
  told("pictures-told", WORDS.pictures_told, found[chosen("model")]);
});
