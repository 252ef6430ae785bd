/* The controls of the 3D view: layers, sizes, limits, section, distances, images. */
/* global byId, fullScreen, distanceBetween, showScaleBar */
/* exported spaceTools */
"use strict";
const AXIS_COLORS = ["#f0928a", "#93d193", "#9dbcf5"];
const [AXIS_NAMES, ENU_NAMES] = [
  ["x", "y", "z"],
  ["E", "N", "up"],
];

/* A number rounded to significant digits. */
function inDigits(value, digits) {
  if (!Number.isFinite(value)) return "\u221e";
  return Number(value.toPrecision(digits)).toString();
}
/* A coordinate to a ten-thousandth of the scene, however far from zero that lies. */
function placeInWords(value, radius) {
  const places = Math.min(12, Math.max(0, 4 - Math.floor(Math.log10(radius))));
  return String(Number(value.toFixed(places)));
}
/* A length with as many decimals as its deviation has, of two digits. */
function besideItsError(length, sigma) {
  const places = 1 - Math.floor(Math.log10(sigma));
  return places < 0 || places > 12 ? inDigits(length, 4) : length.toFixed(places);
}
function lengthInWords({ length, sigma }, unit, scale, errorWords) {
  const named = unit ? ` ${unit}` : "";
  if (sigma === null) return `${inDigits(length, 4)}${named}${scale}; its error is unknown`;
  if (sigma === Infinity) return `${inDigits(length, 4)}${named}${scale}; the images do not determine it`;
  const why = errorWords ? ` (${errorWords})` : "";
  return `${besideItsError(length, sigma)} \u00b1 ${inDigits(sigma, 2)}${named}${scale}, one standard deviation${why}`;
}

/* The scale that a person has set: meters per unit, and its relative error (null: unknown). The browser keeps it for
   this scene; another model under the same name has other bounds, and another unit. */
const scaleKey = (data) => `epipole-scale ${[...data.low, ...data.high, data.radius].join(" ")}`;
function ownScale(data, changed) {
  const form = byId("set-scale"),
    key = scaleKey(data);
  let scale = null;
  const keep = (value) => {
    scale = value;
    try {
      if (value) localStorage.setItem(key, JSON.stringify(value));
      else localStorage.removeItem(key);
    } catch {
      // A browser may refuse to store anything for a page from disk.
    }
    if (form) byId("unset-scale").hidden = !value;
    changed();
  };
  const inMeters = ({ length, sigma }) => {
    if (!scale) return { length, sigma, unit: data.unit, words: data.scaleWords };
    const own = scale.meters * length,
      isKnown = sigma !== null && scale.relative !== null,
      known = isKnown ? Math.hypot(scale.meters * sigma, scale.relative * own) : null;
    return { length: own, sigma: known, unit: "m", words: ", with the scale set here" };
  };
  if (form) {
    try {
      scale = JSON.parse(localStorage.getItem(key));
    } catch {
      scale = null;
    }
    if (!(scale && scale.meters > 0 && (scale.relative === null || scale.relative >= 0))) scale = null;
    byId("unset-scale").hidden = !scale;
    byId("unset-scale").addEventListener("click", () => keep(null));
  }
  /* `found` is the distance between two points, in the scene's unit. */
  const offer = (found) => {
    if (!form) return;
    form.hidden = !(found && found.length > 0);
    if (form.hidden) return;
    form.onsubmit = (event) => {
      event.preventDefault();
      const meters = Number(byId("true-length").value) / found.length;
      if (!(meters > 0 && Number.isFinite(meters))) return;
      const relative = Number.isFinite(found.sigma ?? NaN) ? found.sigma / found.length : null;
      keep({ meters, relative });
    };
  };
  return { inMeters, offer };
}

/* What the colors of lines and of colored points mean. */
function fillLegend(list, data, look) {
  const rows = data.curves
    .map((curve, k) => ({ curve, isShown: look.shown[`curve-${k}`] }))
    .filter(({ isShown }) => isShown)
    .map(({ curve }) => [`rgb(${curve.rgb.join(",")})`, curve.name]);
  const measure = look.colorBy > 0 && data.points.map((p) => p.measures && p.measures[look.colorBy - 1]).find(Boolean);
  if (measure) {
    const stops = Array.from({ length: 16 }, (_, k) => data.ramp.slice(3 * k, 3 * k + 3)),
      css = stops.map((rgb) => `rgb(${rgb.map((v) => Math.round(255 * v)).join(",")})`).join(",");
    const ends = [measure.low, measure.high].map((value) => inDigits(value, 3)).join(" to ");
    rows.push([`linear-gradient(90deg,${css})`, `${measure.name}, ${ends} ${measure.unit}`.trim()]);
  }
  list.replaceChildren(
    ...rows.map(([background, text]) => {
      const row = document.createElement("li"),
        swatch = document.createElement("i");
      swatch.style.background = background;
      row.append(swatch, text);
      return row;
    }),
  );
}

function spaceTools(
  canvas,
  data,
  { look, redraw, placeAt, stepCamera, changePicture, reset, above, snapshot },
) {
  const marks = byId("space-marks"),
    measured = byId("measured"),
    measureButton = byId("measure");
  let ends = [];
  const own = ownScale(data, () => {
    showLength();
    redraw();
  });
  const legend = () => fillLegend(byId("legend"), data, look);

  const each = (selector, act) => document.querySelectorAll(selector).forEach(act);
  each(".show-layer", (box) => {
    look.shown[box.dataset.layer] = box.checked; // a browser may keep them over a reload
    box.addEventListener("input", () => {
      look.shown[box.dataset.layer] = box.checked;
      legend();
      redraw();
    });
  });
  const follow = (id, act) => {
    if (!byId(id)) return;
    const take = () => {
      act(Number(byId(id).value));
      redraw();
    };
    byId(id).addEventListener("input", take);
    take();
  };
  follow("point-size", (value) => (look.pointPx = value));
  follow("frustum-size", (value) => (look.frustum = value));
  follow("picture-opacity", (value) => (look.opacity = value));
  const kind = byId("picture-kind");
  if (kind) kind.addEventListener("change", () => changePicture(kind.value));
  follow("point-color", (value) => {
    look.colorBy = value;
    legend();
  });
  legend();

  /* One slider a measure, from its least to its largest value; beyond the last step is everything. */
  each(".point-limit", (slider) => {
    const [layer, q] = [Number(slider.dataset.layer), Number(slider.dataset.measure)],
      measure = data.points[layer].measures[q],
      told = slider.parentElement.querySelector("output");
    const take = () => {
      const t = Number(slider.value) / 1000,
        value = measure.low + t * (measure.high - measure.low),
        isAll = measure.isAtLeast ? t === 0 : t === 1;
      look.limits[layer][2 * q + (measure.isAtLeast ? 0 : 1)] = isAll ? (measure.isAtLeast ? 0 : 1) : t;
      told.textContent = isAll ? "all" : `${inDigits(value, 3)} ${measure.unit}`.trim();
      slider.setAttribute("aria-valuetext", told.textContent);
      redraw();
    };
    slider.addEventListener("input", take);
    take();
  });

  /* A thousand steps a side, of the middle of the scene; the ends of a slider leave nothing out. */
  function takeSection() {
    const box = { low: [-1e30, -1e30, -1e30], high: [1e30, 1e30, 1e30] };
    each(".section-side", (slider) => {
      const axis = Number(slider.dataset.axis),
        t = Number(slider.value) / 1000,
        value = data.low[axis] + t * (data.high[axis] - data.low[axis]),
        isLow = slider.dataset.side === "low";
      if (isLow ? t > 0 : t < 1) box[slider.dataset.side][axis] = value;
      const isAll = isLow ? t === 0 : t === 1;
      const told = isAll ? "all" : placeInWords(value + data.origin[axis], 100 * data.radius);
      slider.setAttribute("aria-valuetext", told);
      slider.parentElement.querySelector("output").textContent = told;
    });
    look.box = box;
    redraw();
  }
  each(".section-side", (slider) => slider.addEventListener("input", takeSection));
  byId("whole-section").addEventListener("click", () => {
    each(".section-side", (slider) => (slider.value = slider.dataset.side === "low" ? 0 : 1000));
    takeSection();
  });
  takeSection();

  const isMeasuring = () => measureButton.getAttribute("aria-pressed") === "true";
  function setMeasuring(is) {
    measureButton.setAttribute("aria-pressed", String(is));
    ends = [];
    own.offer(null);
    measured.textContent = is ? "Click a point, then another (or press Enter for the middle of the view)." : "";
    redraw();
  }
  measureButton.addEventListener("click", () => setMeasuring(!isMeasuring()));
  function measureAt(x, y) {
    const hit = placeAt(x, y);
    if (!hit) {
      measured.textContent = "There is nothing at this pixel.";
      return;
    }
    ends = ends.length === 2 ? [hit] : [...ends, hit];
    if (ends.length === 1) {
      own.offer(null);
      const place = hit.place.map((v, k) => placeInWords(v + data.origin[k], data.radius)).join(", ");
      measured.textContent = `From (${place}) to \u2026`;
    } else {
      own.offer(distanceBetween(...ends));
      showLength();
    }
    redraw();
  }
  function showLength() {
    if (ends.length < 2) return;
    const found = own.inMeters(distanceBetween(...ends));
    measured.textContent = lengthInWords(found, found.unit, found.words, ends[0].errorWords);
    measured.dataset.length = found.length;
    measured.dataset.sigma = found.sigma === null ? "" : found.sigma;
  }
  canvas.addEventListener("keydown", (event) => {
    if (event.key === "Enter" && isMeasuring())
      measureAt(0.5 * canvas.clientWidth, 0.5 * canvas.clientHeight);
    if (event.key === "Escape" && isMeasuring()) setMeasuring(false);
  });

  if (data.cameras && data.cameras.names.length) {
    byId("next-camera").addEventListener("click", () => stepCamera(1));
    byId("last-camera").addEventListener("click", () => stepCamera(-1));
  }
  byId("reset-view").addEventListener("click", reset);
  byId("view-above").addEventListener("click", above);
  const drawers = document.querySelectorAll(".stage .drawer");
  for (const drawer of drawers)
    drawer.addEventListener("toggle", () => {
      if (drawer.open) drawers.forEach((other) => other !== drawer && (other.open = false));
    });
  byId("full-screen").hidden = !document.fullscreenEnabled;
  byId("full-screen").addEventListener("click", () => fullScreen(canvas.parentElement));
  byId("save-picture").addEventListener("click", () =>
    snapshot((blob) => {
      const link = document.createElement("a"),
        name = data.title.replace(/[^\p{L}\p{N}_.-]+/gu, "_").replace(/^[._]+/, "");
      link.href = URL.createObjectURL(blob);
      link.download = `${name || "scene"}.png`;
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    }),
  );

  const element = (kind, attributes) => {
    const made = document.createElementNS(marks.namespaceURI, kind);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    return made;
  };
  /* The axes in a corner, and what is being measured. Two drawings: to draw the whole anew is slow in software. */
  function mark({ basis, focal, near, dist }) {
    const scale = (focal * canvas.clientWidth) / canvas.width;
    showScaleBar(byId("scale-bar"), scale / dist, own.inMeters({ length: 1, sigma: null }), canvas.clientWidth);
    const axes = (data.isEnu ? ENU_NAMES : AXIS_NAMES).map((label, k) => {
      const [x, y, dx, dy] = [38, 38, 22 * basis.r[k], 22 * basis.d[k]],
        color = AXIS_COLORS[k];
      const text = element("text", { x: x + 1.4 * dx, y: y + 1.4 * dy + 4 });
      text.textContent = label;
      if (label === "N") text.style.fontWeight = "bold";
      text.style.fill = color; // before the style of the page's other drawings
      return [
        element("line", { x1: x, y1: y, x2: x + dx, y2: y + dy, stroke: color, "stroke-width": 1.5 }),
        text,
      ];
    });
    byId("space-axes").replaceChildren(...axes.map(([line]) => line), ...axes.map(([, text]) => text));
    if (!ends.length && !marks.childElementCount) return;
    const drawn = [];
    const seen = ends.map(({ place }) => {
      const ray = place.map((v, k) => v - basis.o[k]),
        [x, y, z] = [basis.r, basis.d, basis.f].map((a) => a[0] * ray[0] + a[1] * ray[1] + a[2] * ray[2]);
      return z > near
        ? [0.5 * canvas.clientWidth + (scale * x) / z, 0.5 * canvas.clientHeight + (scale * y) / z]
        : null;
    });
    if (seen.length === 2 && seen[0] && seen[1]) {
      const [[x1, y1], [x2, y2]] = seen;
      const dashes = { stroke: "#ffd34d", "stroke-width": 2, "stroke-dasharray": "5 4" };
      drawn.push(element("line", { x1, y1, x2, y2, ...dashes }));
    }
    for (const pixel of seen.filter(Boolean))
      drawn.push(
        element("circle", { cx: pixel[0], cy: pixel[1], r: 4.5, fill: "#ffd34d", stroke: "#14191d" }),
      );
    marks.replaceChildren(...drawn);
  }
  function showCamera(k) {
    const label = byId("camera-name");
    if (label)
      label.textContent = k < 0 ? "" : `${k + 1} of ${data.cameras.names.length}: ${data.cameras.names[k]}`;
    if (!byId("camera-picture")) return;
    const address = k < 0 ? null : (data.cameras[look.picture] || [])[k];
    byId("camera-picture").hidden = !address;
    if (address) {
      byId("camera-picture").src = address;
      byId("camera-picture").alt =
        `The ${look.picture === "depths" ? "depth" : "image"} of ${data.cameras.names[k]}`;
    }
  }
  return { mark, measureAt, isMeasuring, setMeasuring, showCamera };
}
