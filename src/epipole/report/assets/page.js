/* The frame of a page with scripts: hover text, sorting, enlarged images. No library. */
/* exported bytesOf, cssColor, darkScheme, NAMES, showTip, fitCanvas */
"use strict";
const byId = (id) => document.getElementById(id);
const readJson = (id) => (byId(id) ? JSON.parse(byId(id).textContent) : null);
const cssColor = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const darkScheme = matchMedia("(prefers-color-scheme: dark)");
const NAMES = readJson("names") || [];

function bytesOf(text) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const binary = atob(text),
    out = new Uint8Array(binary.length);
  for (let k = 0; k < binary.length; k++) out[k] = binary.charCodeAt(k);
  return out;
}

function showTip(event, text) {
  const tip = byId("tip");
  tip.hidden = !text;
  if (!text) return;
  tip.textContent = text;
  const box = tip.getBoundingClientRect();
  tip.style.left = Math.max(4, Math.min(event.clientX + 14, innerWidth - box.width - 6)) + "px";
  tip.style.top = Math.max(4, Math.min(event.clientY + 16, innerHeight - box.height - 6)) + "px";
}

function fitCanvas(canvas, maxRatio) {
  const ratio = Math.min(devicePixelRatio || 1, maxRatio);
  const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
  const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  return ratio;
}

for (const head of document.querySelectorAll("table.sortable th[data-sort]")) {
  head.addEventListener("click", () => {
    const table = head.closest("table"),
      body = table.tBodies[0],
      column = head.cellIndex;
    const numeric = head.dataset.sort === "number";
    const upward = head.getAttribute("aria-sort") !== "ascending";
    for (const other of table.querySelectorAll("th[aria-sort]")) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", upward ? "ascending" : "descending");
    const sign = upward ? 1 : -1;
    const keyOf = (row) => (numeric ? row.cells[column].dataset.key : row.cells[column].textContent);
    const compare = (a, b) => {
      const p = keyOf(a),
        q = keyOf(b);
      if (!numeric) return sign * p.localeCompare(q, undefined, { numeric: true });
      if (p === "" || q === "") return (p === "") - (q === "");
      return sign * (Number(p) - Number(q));
    };
    body.append(...[...body.rows].sort(compare));
  });
}

for (const button of document.querySelectorAll("button.zoom")) {
  button.addEventListener("click", () => {
    const dialog = byId("enlarged");
    const caption = document.createElement("p");
    caption.textContent = button.closest("tr").querySelector("th").textContent;
    dialog.replaceChildren(button.querySelector("svg").cloneNode(true), caption);
    dialog.showModal();
  });
}
byId("enlarged").addEventListener("click", (event) => event.currentTarget.close());
