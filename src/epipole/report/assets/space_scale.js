/* The scale bar of the 3D view: a round length, at the depth of the view's center. */
/* exported showScaleBar */
"use strict";
const [BAR_PX, BAR_RATIO] = [130, 0.3]; // the longest bar, and as a fraction of the view's width
const METRIC = [
  [1000, "km"],
  [1, "m"],
  [0.01, "cm"],
  [0.001, "mm"],
];

/* The largest of 1, 2 or 5 times a power of ten up to `most`. */
function roundLength(most) {
  const power = 10 ** Math.floor(Math.log10(most) + 1e-9);
  return [5, 2, 1].find((digit) => digit * power <= most * (1 + 1e-9)) * power;
}

/* `pxPerUnit` pixels of the page for one unit of the scene, which is `length` of `unit`. */
function showScaleBar(bar, pxPerUnit, { length, unit }, widthPx) {
  const most = (Math.min(BAR_PX, BAR_RATIO * widthPx) * length) / pxPerUnit;
  bar.hidden = !(most > 1e-12 && most < 1e12);
  if (bar.hidden) return;
  const [size, name] = unit === "m" ? METRIC.find(([meters]) => most >= meters) || METRIC[3] : [1, ""],
    round = roundLength(most / size),
    digits = Number(round.toPrecision(1)),
    text = `${digits} ${name || (digits === 1 ? "unit" : "units")}`;
  bar.lastElementChild.style.width = `${((round * size * pxPerUnit) / length).toFixed(1)}px`;
  if (bar.firstElementChild.textContent === text) return;
  bar.firstElementChild.textContent = text;
  bar.setAttribute("aria-label", `Scale bar at the depth of the view's center: ${text}`);
}
