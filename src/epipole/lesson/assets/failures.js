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

/* Root mean square distance of the places that are known to the true ones, in centimetres; NaN where none is. */
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

function drawSeen({ run, k, pictures }) {
  const at = run.shown.reduce(
    (best, shown, i) => (Math.abs(shown - k) < Math.abs(run.shown[best] - k) ? i : best),
    0,
  );
  const svg = clear("seen");
  svg.setAttribute("viewBox", "0 0 4 3");
  add(svg, "image", {
    href: "data:image/webp;base64," + pictures[at],
    width: 4,
    height: 3,
    preserveAspectRatio: "none",
  });
  const box = run.moving[run.shown[at]];
  if (box)
    add(svg, "rect", {
      class: "moves",
      x: 4 * box[0],
      y: 4 * box[1],
      width: 4 * (box[2] - box[0]),
      height: 4 * (box[3] - box[1]),
    });
}

function drawWay({ run, k }) {
  const [svg, width] = fitted("way", (all) => 0.75 * all),
    { now, final } = placesOf(run);
  const all = [...run.truth, ...now.filter(Boolean), ...final.filter(Boolean)],
    [low, high] = [Math.min, Math.max].map((end) =>
      [0, 1].map((axis) => end(...all.map((place) => place[axis]))),
    );
  const middle = scaled(plus(low, high), 0.5),
    size =
      Math.min(width / Math.max(high[0] - low[0], 0.4), (0.75 * width) / Math.max(high[1] - low[1], 0.4)) *
      0.84;
  const toPlace = ([x, y]) => [width / 2 + size * (x - middle[0]), 0.375 * width - size * (y - middle[1])];
  add(svg, "path", { class: "thin", fill: "none", d: "M" + run.truth.map(toPlace).join(" L") });
  final.forEach(
    (place) =>
      place && add(svg, "circle", { class: "behind", cx: toPlace(place)[0], cy: toPlace(place)[1], r: 3.4 }),
  );
  now.slice(0, k + 1).forEach((place) => {
    if (!place) return;
    const [cx, cy] = toPlace(place);
    add(svg, "circle", { class: "one", cx, cy, r: 2.4 });
  });
  const [cx, cy] = toPlace(run.truth[k]);
  add(svg, "circle", { class: "behind", cx, cy, r: 8 });
  const metre = 10 ** Math.floor(Math.log10((0.5 * width) / size)); // the longest power of ten that fits
  add(svg, "line", {
    class: "measure",
    x1: 14,
    x2: 14 + metre * size,
    y1: 0.75 * width - 14,
    y2: 0.75 * width - 14,
  });
  add(svg, "text", { class: "label", x: 14, y: 0.75 * width - 20 }, `${metre} ${WORDS.metre}`);
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
      class: "ray " + { sfm_fusion: "grey", ours_fusion: "other", ours_sfm: "one" }[name],
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
    for (const name of Object.keys(RUNS)) byId(`about-${name}`).hidden = name !== failure;
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
document.documentElement.dataset.ready = "yes";
