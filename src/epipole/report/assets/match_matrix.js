/* The matrix of matches: a cell per pair of images. */
/* global byId, readJson, cssColor, darkScheme, NAMES, showTip, fitCanvas */
"use strict";
function matchMatrix(canvas, data) {
  const n = data.n,
    margin = 30,
    placed = new Set(data.placed);
  const most = Math.max(1, ...data.count),
    pairAt = new Map();
  data.count.forEach((_, k) => {
    pairAt.set(data.first[k] * n + data.second[k], k);
    pairAt.set(data.second[k] * n + data.first[k], k);
  });
  const mix = (a, b, t) => a.map((v, k) => Math.round(v + (b[k] - v) * t));
  const rgb = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
  const step = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000].find((s) => n / s <= 12) || 5000;

  function draw() {
    const ratio = fitCanvas(canvas, 3),
      pen = canvas.getContext("2d"),
      side = canvas.clientWidth;
    const cell = (side - margin - 1) / n,
      at = (k) => margin + k * cell;
    const snap = (v) => Math.round(v * ratio) / ratio;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, side, side);
    pen.fillStyle = cssColor("--panel");
    pen.fillRect(margin, margin, cell * n, cell * n);
    const low = rgb(cssColor("--ramp0")),
      high = rgb(cssColor("--ramp1"));
    const gap = cell >= 7 ? 1 : 0;
    data.count.forEach((value, k) => {
      pen.fillStyle = `rgb(${mix(low, high, Math.log(Math.max(1, value)) / Math.log(Math.max(2, most)))})`;
      for (const [a, b] of [
        [data.first[k], data.second[k]],
        [data.second[k], data.first[k]],
      ]) {
        const x = snap(at(a)),
          y = snap(at(b));
        pen.fillRect(x, y, snap(at(a + 1)) - x - gap, snap(at(b + 1)) - y - gap);
      }
    });
    pen.fillStyle = cssColor("--line");
    const inner = Math.max(1, cell - gap);
    for (let k = 0; k < n; k++) pen.fillRect(snap(at(k)), snap(at(k)), inner, inner);
    pen.fillStyle = cssColor("--warn");
    for (let k = 0; k < n; k++) {
      if (placed.has(k)) continue;
      pen.fillRect(margin - 5, at(k), 3, inner);
      pen.fillRect(at(k), margin - 5, inner, 3);
    }
    pen.strokeStyle = cssColor("--line");
    pen.strokeRect(margin - 0.5, margin - 0.5, cell * n + 1, cell * n + 1);
    pen.fillStyle = cssColor("--soft");
    pen.font = "11.5px system-ui, sans-serif";
    for (let k = 0; k < n; k += step) {
      pen.textAlign = "center";
      pen.textBaseline = "alphabetic";
      pen.fillText(k + 1, at(k + 0.5), margin - 9);
      pen.textAlign = "right";
      pen.textBaseline = "middle";
      pen.fillText(k + 1, margin - 8, at(k + 0.5));
    }
  }
  canvas.addEventListener("pointermove", (event) => {
    const cell = (canvas.clientWidth - margin - 1) / n;
    const [column, row] = [event.offsetX, event.offsetY].map((v) => Math.floor((v - margin) / cell));
    const inside = column >= 0 && row >= 0 && column < n && row < n;
    if (!inside) return showTip(event, "");
    const title = row === column ? NAMES[row] : NAMES[row] + "\n" + NAMES[column];
    const k = pairAt.get(row * n + column);
    if (row === column) return showTip(event, title);
    if (k === undefined) return showTip(event, title + "\nno verified match");
    const angle = data.angle[k] === null ? "no angle" : "median angle " + data.angle[k] + "\u00b0";
    const kind = data.kinds[data.kind[k]] || "kind " + data.kind[k];
    showTip(event, `${title}\n${data.count[k]} inliers of ${data.putative[k]} matches, ${kind}, ${angle}`);
  });
  canvas.addEventListener("pointerleave", (event) => showTip(event, ""));
  new ResizeObserver(draw).observe(canvas);
  darkScheme.addEventListener("change", draw);
  draw();
}
if (byId("matrix")) matchMatrix(byId("matrix"), readJson("pairs"));
