/* A small figure for each failure: what the camera sees, and the trajectories of its runs beside each other. */

/* What is shown of a run at frame k, under its trajectory. */
function runWords(failure, name, k) {
  const run = RECORD[failure][name],
    { final } = placesOf(run),
    off = errorOf(final, run.truth);
  const rejected = run.loops.filter(([seen, verdict]) => seen <= k && verdict === "rejected").length;
  const state = worded(WORDS.now, { state: WORDS.states[run.state[k]] }),
    points = worded(WORDS.points_now, { points: grouped(String(run.points[k])) });
  const error = Number.isNaN(off) ? WORDS.no_position : worded(WORDS.final_error, { off: withUnit(off, "cm") });
  const loops = rejected ? [worded(WORDS.loops_rejected, { rejected: grouped(String(rejected)) })] : [];
  return { off, rejected, lines: [WORDS.runs[name], state, points, error, ...loops] };
}

/* Where panels stand: images and trajectories in two columns, or three if all runs see the same images. */
function panelsOf(failure, width) {
  const names = RUNS[failure],
    own = names.map((name) => RECORD[failure][name].pictures.length > 0),
    isShared = names.length > 1 && !own[1],
    columns = isShared && width >= 560 ? 3 : 2,
    gap = 12,
    wide = (width - gap * (columns + 1)) / columns;
  const at = (column, row) => ({ x: gap + column * (wide + gap), y: gap + row * (0.75 * wide + 106), width: wide, height: 0.75 * wide });
  const panels = [];
  names.forEach((name, k) => {
    if (isShared && columns === 2) {
      if (!k) panels.push({ name, kind: "image", box: { ...at(0, 0), x: (width - wide) / 2 } });
      panels.push({ name, kind: "way", box: { ...at(k, 0), y: 0.75 * wide + 2 * gap } });
    } else if (isShared) {
      if (!k) panels.push({ name, kind: "image", box: at(0, 0) });
      panels.push({ name, kind: "way", box: at(k + 1, 0) });
    } else {
      panels.push({ name, kind: "image", box: at(0, k) }, { name, kind: "way", box: at(1, k) });
    }
  });
  return panels;
}

function drawFailure(failure, k) {
  const id = `view-${failure}`,
    runs = RUNS[failure].map((name) => RECORD[failure][name]);
  let panels = [];
  const [svg] = fitted(id, (width) => {
    panels = panelsOf(failure, width);
    return Math.max(...panels.map(({ box }) => box.y + box.height)) + 114;
  });
  const extent = extentOf(runs);
  for (const { name, kind, box } of panels) {
    const run = RECORD[failure][name],
      pictures = run.pictures.length ? run.pictures : runs[0].pictures;
    if (kind === "image") {
      imageIn(svg, box, run, k, pictures);
      continue;
    }
    add(svg, "rect", { class: "frame", ...box });
    trajectoryIn(svg, box, run, k, extent, { dot: 0.7, below: 26 });
    runWords(failure, name, k).lines.forEach((text, row) =>
      add(svg, "text", { class: `label ${row ? "" : "strong"}`, x: box.x, y: box.y + box.height + 20 + 20 * row }, text),
    );
  }
  const said = RUNS[failure].map((name) => runWords(failure, name, k).lines.join(" · ")).join(WORDS.and);
  byId(`${id}-told`).textContent = said;
}

for (const failure of Object.keys(RUNS))
  watch([`at-${failure}`], (values) => drawFailure(failure, values[`at-${failure}`]));
document.documentElement.dataset.ready = "yes";
