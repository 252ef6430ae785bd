/* Replays of recorded runs: what was seen, what was said, and where the camera was. */
const RECORD = JSON.parse(byId("scene").textContent);
const RUNS = {
  wall: ["rgbd"],
  tiles: ["rgbd"],
  moving: ["rgbd", "mono"],
  blur: ["long", "short"],
  shutter: ["untold", "told"],
  rotation: ["mono", "rgbd"],
};

/* A place that was said: of a camera that only turns, or has no map yet, it is where the path was begun. */
const isPlaced = (run, k) => run.place[k] && run.state[k] !== "turning" && run.state[k] !== "starting";
const placesOf = (run) => ({
  now: run.place.map((place, k) => (isPlaced(run, k) ? place : null)),
  final: run.final.map((place, k) => (run.state[k] === "turning" ? null : place)),
});

/* What the run says, in the page's language: its numbers stand in for each #. */
function reasonOf(said) {
  return said
    .split("; ")
    .map((part) => {
      const numbers = part.match(/\d+(\.\d+)?/g) || [],
        known = WORDS.reasons.find((reason) => reason.said === part.replace(/\d+(\.\d+)?/g, "#"));
      return known ? known.told.replace(/#/g, () => numbers.shift()) : part;
    })
    .join(WORDS.and);
}

const runOf = (failure) => {
  const names = RUNS[failure],
    which = Math.min(Number(chosen("run")), names.length - 1);
  return { name: names[which], run: RECORD[failure][names[which]], first: RECORD[failure][names[0]] };
};

/* Root mean square distance of the places that are known to the true ones, in centimeters; NaN where none is. */
function errorOf(places, truth) {
  const off = places.flatMap((place, k) => (place ? [norm(minus(place, truth[k]))] : []));
  return off.length ? 100 * Math.sqrt(dot(off, off) / off.length) : NaN;
}

function replayNumbers({ failure, frame }) {
  const { name, run, first } = runOf(failure),
    count = run.state.length,
    k = Math.min(Math.round(frame), count - 1);
  const before = run.loops.filter(([seen]) => seen <= k),
    { now, final } = placesOf(run),
    place = now[k];
  const numbers = {
    points: run.points[k],
    off_now: place ? 100 * norm(minus(place, run.truth[k])) : NaN,
    placed: (100 * now.filter(Boolean).length) / count,
    final_off: errorOf(final, run.truth),
    refused: before.filter(([, verdict]) => verdict === "rejected").length,
    accepted: before.filter(([, verdict]) => verdict === "accepted").length,
  };
  return { name, run, k, numbers, pictures: run.pictures.length ? run.pictures : first.pictures };
}

/* The recorded image that is nearest in time to frame k, and the object in it that moves. */
function imageIn(svg, { x, y, width }, run, k, pictures) {
  const at = run.shown.reduce((best, shown, i) => (Math.abs(shown - k) < Math.abs(run.shown[best] - k) ? i : best), 0),
    inside = add(svg, "svg", { x, y, width, height: 0.75 * width, viewBox: "0 0 4 3" });
  const href = "data:image/webp;base64," + pictures[at];
  add(inside, "image", { href, width: 4, height: 3, preserveAspectRatio: "none" });
  const box = run.moving[run.shown[at]];
  if (!box) return;
  const [left, top, right, bottom] = [4, 3, 4, 3].map((size, i) => size * box[i]);
  add(inside, "rect", { class: "moves", x: left, y: top, width: right - left, height: bottom - top });
}

function drawSeen({ run, k, pictures }) {
  const svg = clear("seen");
  svg.setAttribute("viewBox", "0 0 4 3");
  imageIn(svg, { x: 0, y: 0, width: 4 }, run, k, pictures);
}

/* Middle and size of the scene that some runs move in. */
function extentOf(runs) {
  const all = runs.flatMap((run) => {
    const { now, final } = placesOf(run);
    return [...run.truth, ...now.filter(Boolean), ...final.filter(Boolean)];
  });
  const [low, high] = [Math.min, Math.max].map((end) => [0, 1].map((axis) => end(...all.map((place) => place[axis]))));
  return { middle: scaled(plus(low, high), 0.5), size: [0, 1].map((axis) => Math.max(high[axis] - low[axis], 0.4)) };
}

/* A trajectory from above: the true one, what is known of it, and a length for comparison; `dot` is the size of its marks, and
   `below` the room for the length alone. */
function trajectoryIn(svg, { x, y, width, height }, run, k, { middle, size }, { dot = 1, below = 0 } = {}) {
  const { now, final } = placesOf(run),
    scale = 0.84 * Math.min(width / size[0], (height - below) / size[1]);
  const toPlace = ([a, b]) => [x + width / 2 + scale * (a - middle[0]), y + (height - below) / 2 - scale * (b - middle[1])];
  const mark = (place, kind, r) => {
    const [cx, cy] = toPlace(place);
    add(svg, "circle", { class: kind, cx, cy, r: r * dot });
  };
  add(svg, "path", { class: "thin", fill: "none", d: "M" + run.truth.map(toPlace).join(" L") });
  final.forEach((place) => place && mark(place, "behind", 3.4));
  now.slice(0, k + 1).forEach((place) => place && mark(place, "one", 2.4));
  mark(run.truth[k], "behind", 8);
  const meter = 10 ** Math.floor(Math.log10((0.5 * width) / scale)), // the longest power of ten that fits
    [left, low] = [x + 14, y + height - (below ? 8 : 14)];
  add(svg, "line", { class: "measure", x1: left, x2: left + meter * scale, y1: low, y2: low });
  add(svg, "text", { class: "label", x: left, y: low - 6 }, `${meter} ${WORDS.meter}`);
}

function drawWay({ run, k }) {
  const [svg, width] = fitted("way", (all) => 0.75 * all);
  trajectoryIn(svg, { x: 0, y: 0, width, height: 0.75 * width }, run, k, extentOf([run]));
}

const SHADES = { tracking: "good", turning: "half", starting: "half", submap: "half", lost: "bad" };

function drawPoints({ run, k }) {
  const [svg, width] = fitted("agreeing", 150),
    box = { left: 46, top: 26, right: width - 12, bottom: 108 },
    count = run.state.length;
  const { toX, toY } = chartAxes(
    svg,
    box,
    [count - 1, Math.max(...run.points, 10)],
    [WORDS.frame, WORDS.agreeing],
  );
  const wide = (box.right - box.left) / count + 0.6;
  run.state.forEach((state, i) =>
    add(svg, "rect", {
      class: SHADES[state],
      x: toX(i) - wide / 2,
      y: box.bottom - 5,
      width: wide,
      height: 5,
    }),
  );
  add(svg, "path", { class: "ray one", d: "M" + run.points.map((n, i) => `${toX(i)},${toY(n)}`).join(" L") });
  add(svg, "line", { class: "measure", x1: toX(k), x2: toX(k), y1: box.top, y2: box.bottom });
}

/* How far three answers to where the camera was are from each other. */
function drawKitchen() {
  const [svg, width] = fitted("kitchen", 260),
    box = { left: 46, top: 30, right: width - 12, bottom: 210 };
  const names = ["sfm_fusion", "ours_fusion", "ours_sfm"],
    { number } = RECORD.kitchen;
  const most = 100 * Math.max(...names.flatMap((name) => RECORD.kitchen[name]));
  const { toX, toY } = chartAxes(svg, box, [number.at(-1), most], [WORDS.picture, WORDS.apart]);
  names.forEach((name) => {
    const d = "M" + RECORD.kitchen[name].map((v, k) => `${toX(number[k])},${toY(100 * v)}`).join(" L");
    add(svg, "path", {
      class: "ray " + { sfm_fusion: "gray", ours_fusion: "other", ours_sfm: "one" }[name],
      d,
    });
    const values = RECORD.kitchen[name];
    show(`rms-${name}`, 100 * Math.sqrt(dot(values, values) / values.length), "cm", 3);
  });
  told("kitchen-told", WORDS.kitchen_told, { longest: most });
}

let begun = "";

watch(["frame"], ({ frame }) => {
  const failure = chosen("failure"),
    slider = byId("frame");
  if (failure !== begun) {
    begun = failure;
    slider.max = String(RECORD[failure][RUNS[failure][0]].state.length - 1);
    frame = Math.min(frame, Number(slider.max));
    slider.value = String(frame);
    byId("run-1").parentElement.hidden = RUNS[failure].length < 2;
    document.querySelector("input[name=run][value='0']").checked = true;
  }
  byId("frame-shown").textContent = slider.value;
  RUNS[failure].forEach((name, k) => (byId(`run-${k}`).textContent = WORDS.runs[name]));
  const found = replayNumbers({ failure, frame });
  for (const [name, value] of Object.entries(found.numbers)) {
    const unit = { off_now: "cm", final_off: "cm", placed: "%" }[name];
    if (["points", "refused", "accepted"].includes(name)) showCount(name, value);
    else show(name, value, unit);
  }
  byId("state").textContent = WORDS.states[found.run.state[found.k]];
  byId("state").dataset.state = found.run.state[found.k];
  byId("reason").textContent = reasonOf(found.run.reason[found.k]) || "–";
  drawSeen(found);
  drawWay(found);
  drawPoints(found);
  told("way-told", WORDS.way_told, found.numbers);
  told("agreeing-told", WORDS.agreeing_told, found.numbers, ["points"]);
});
drawKitchen();
addEventListener("resize", drawKitchen);

/* Played on request alone: nothing on the page moves by itself. */
let playing = 0;
byId("play").addEventListener("click", () => {
  const button = byId("play");
  const stop = () => {
    clearInterval(playing);
    playing = 0;
    button.textContent = WORDS.play;
  };
  if (playing) return stop();
  const slider = byId("frame");
  if (slider.value === slider.max) slider.value = "0";
  button.textContent = WORDS.pause;
  playing = setInterval(() => {
    slider.value = String(Number(slider.value) + 1);
    slider.dispatchEvent(new Event("input"));
    if (slider.value === slider.max) stop();
  }, 120);
});
