/* What every page of the lesson does: sliders and their numbers, drawings in SVG, charts. No library. */
/* exported byId, show, showCount, withUnit, grouped, chosen, told, worded, watch, clear, fitted, add, place, drag, marks, chartAxes, shownNumber */
"use strict";
const byId = (id) => document.getElementById(id);
const WORDS = JSON.parse(byId("words").textContent);
const SVG = "http://www.w3.org/2000/svg";

const RAISED = { "-": "⁻", 0: "⁰", 1: "¹", 2: "²", 3: "³", 4: "⁴", 5: "⁵", 6: "⁶", 7: "⁷", 8: "⁸", 9: "⁹" };
const grouped = (text) => text.replace(/^(-?\d+)/, (whole) => whole.replace(/\B(?=(\d{3})+$)/g, ","));
const withMinus = (text) => text.replace(/-/g, "−");

/* A number with this many significant digits: 2.40, 175,827, 1.20 × 10⁶. */
function shownNumber(value, digits = 3) {
  if (value === Infinity) return WORDS.infinite || "∞";
  if (value === -Infinity) return "−∞";
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size < 1e-9) return "0"; // rounding
  if (size < 1e-4 || size >= 1e6) {
    const [factor, power] = value.toExponential(digits - 1).split("e");
    return `${withMinus(factor)} × 10${[...String(Number(power))].map((mark) => RAISED[mark]).join("")}`;
  }
  const places = Math.max(0, digits - 1 - Math.floor(Math.log10(Number(size.toPrecision(digits)))));
  return withMinus(grouped(value.toFixed(Math.min(places, 6))));
}

/* A number with its unit; lengths below 0.1 m are in cm or mm. */
function withUnit(value, unit, digits = 3) {
  if (!unit || !Number.isFinite(value)) return shownNumber(value, digits);
  const size = Math.abs(value);
  if (unit === "m" && size >= 1e-9 && size < 0.1)
    return size < 0.01
      ? `${shownNumber(1000 * value, digits)} mm`
      : `${shownNumber(100 * value, digits)} cm`;
  return `${shownNumber(value, digits)}${unit === "°" ? "" : " "}${unit}`;
}

/* Write a number beside its name; the whole of it stays in `data-value`. */
function show(id, value, unit = "", digits = 3) {
  const element = byId(id);
  element.dataset.value = String(value);
  element.textContent = withUnit(value, unit, digits);
}

/* The same for an integer: all of its digits. */
function showCount(id, value) {
  byId(id).dataset.value = String(value);
  byId(id).textContent = grouped(String(value));
}

/* Which of some radio buttons is set. */
const chosen = (name) => document.querySelector(`input[name=${name}]:checked`).value;

/* A drawing in words, for screen readers; that of the figure whose control moved last is also announced when it rests.
   `counts` names the values that are integers. */
function told(id, words, values, counts = []) {
  byId(id).textContent = words.replace(/\{(\w+)\}/g, (_, name) =>
    counts.includes(name) ? grouped(String(values[name])) : shownNumber(values[name]),
  );
}

/* Words of a drawing with its values, which have their units already. */
const worded = (words, values) => words.replace(/\{(\w+)\}/g, (_, name) => values[name]);

let saying = 0;

function sayWhenStill(control) {
  clearTimeout(saying);
  const figure = control.closest("figure, .widget") || document;
  saying = setTimeout(() => (byId("said").textContent = figure.querySelector("p.told[id]").textContent), 900);
}

/* Arrow keys go from one round number to the next, in about a hundred steps. */
function goByKeys(input, moved) {
  const [least, most] = [Number(input.min), Number(input.max)],
    step = marks(most - least, 100)[1];
  input.addEventListener("keydown", (event) => {
    const way = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 }[event.key];
    if (!way || input.step !== "any") return;
    event.preventDefault();
    const at = Number(input.value) / step,
      next = way > 0 ? Math.floor(at + 1e-9) + 1 : Math.ceil(at - 1e-9) - 1;
    input.value = String(Math.min(most, Math.max(least, Number((next * step).toPrecision(12)))));
    moved();
  });
}

/* Call `draw` with the numbers of all inputs, now and whenever one is moved or a button with numbers is pressed. */
function watch(names, draw) {
  const inputs = names.map(byId);
  const unitOf = (input) =>
    input.dataset.unit === "px" && WORDS.unit_px ? WORDS.unit_px : input.dataset.unit;
  function update() {
    const values = {};
    for (const input of inputs) {
      values[input.id] = Number(input.value);
      const text = input.step === "1" ? input.value : withUnit(values[input.id], unitOf(input));
      byId(input.id + "-shown").textContent = text;
      input.setAttribute("aria-valuetext", text);
    }
    draw(values);
  }
  function set(values) {
    for (const [name, value] of Object.entries(values)) byId(name).value = String(value);
    update();
  }
  for (const input of inputs) {
    let before = input.value;
    const changed = () => {
      update();
      sayWhenStill(input);
    };
    input.addEventListener("input", changed);
    input.addEventListener("pointerdown", () => (before = input.value));
    input.addEventListener("pointercancel", () => {
      input.value = before; // the finger scrolled the page across the slider
      changed();
    });
    goByKeys(input, changed);
  }
  for (const button of document.querySelectorAll("button[data-preset]"))
    button.addEventListener("click", () => {
      set(JSON.parse(button.dataset.preset));
      sayWhenStill(button);
    });
  for (const choice of document.querySelectorAll("input[type=radio]"))
    choice.addEventListener("change", () => {
      update();
      sayWhenStill(choice);
    });
  addEventListener("resize", update);
  update();
  return set;
}

/* Drawings: an element with attributes, added to another. */
function add(parent, kind, attributes = {}, text = "") {
  const element = document.createElementNS(SVG, kind);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  if (text) element.textContent = text;
  parent.append(element);
  return element;
}

function clear(id) {
  const svg = byId(id);
  svg.replaceChildren();
  return svg;
}

/* An empty drawing as wide as it is shown, so that its words can be read on a phone: [drawing, width]. */
function fitted(id, height) {
  const svg = clear(id),
    width = Math.max(340, Math.min(900, svg.clientWidth));
  svg.setAttribute("viewBox", `0 0 ${width} ${typeof height === "function" ? height(width) : height}`);
  return [svg, width];
}

/* Where a pointer is in a drawing's own units. */
function place(svg, event) {
  const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
  return [at.x, at.y];
}

/* Follow a pointer that is pressed on a drawing; `moved` gets its place in the drawing's units. A finger scrolls the page
   instead, unless it begins on what is a `handle`. */
function drag(svg, moved, ended = () => {}) {
  svg.classList.add("draggable");
  const starts = (event) => event.target.classList.contains("handle");
  // A redraw removes the handle that was touched, and with it what keeps the page from scrolling: it waits for touchstart.
  svg.addEventListener("touchstart", (event) => starts(event) && event.preventDefault(), { passive: false });
  svg.addEventListener("pointerdown", (event) => {
    if (event.pointerType === "touch" && !starts(event)) return;
    svg.setPointerCapture(event.pointerId);
    const at = place(svg, event);
    if (event.pointerType === "touch") requestAnimationFrame(() => moved(...at));
    else moved(...at);
  });
  svg.addEventListener("pointermove", (event) => {
    if (svg.hasPointerCapture(event.pointerId)) moved(...place(svg, event));
  });
  svg.addEventListener("lostpointercapture", ended);
}

/* Round numbers from 0 to a largest one, for the marks of an axis. */
function marks(largest, wanted = 5) {
  const rough = largest / wanted,
    power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= rough);
  const out = [];
  for (let k = 0; k * step <= largest * (1 + 1e-9); k++) out.push(k * step);
  return out;
}

/* Axes from 0 to (x, y) in the box {left, top, right, bottom}; the answer maps values to places. */
function chartAxes(svg, box, most, names) {
  const toX = (x) => box.left + ((box.right - box.left) * x) / most[0];
  const toY = (y) => box.bottom - ((box.bottom - box.top) * y) / most[1];
  for (const x of marks(most[0], Math.min(8, (box.right - box.left) / 70))) {
    add(svg, "line", { class: "grid", x1: toX(x), x2: toX(x), y1: box.top, y2: box.bottom });
    add(
      svg,
      "text",
      { class: "tick", x: toX(x), y: box.bottom + 16, "text-anchor": "middle" },
      String(+x.toPrecision(6)),
    );
  }
  for (const y of marks(most[1], 4)) {
    add(svg, "line", { class: "grid", x1: box.left, x2: box.right, y1: toY(y), y2: toY(y) });
    add(
      svg,
      "text",
      { class: "tick", x: box.left - 7, y: toY(y) + 4, "text-anchor": "end" },
      String(+y.toPrecision(6)),
    );
  }
  add(svg, "path", { class: "axis", d: `M${box.left},${box.top} V${box.bottom} H${box.right}` });
  add(svg, "text", { class: "label", x: box.right, y: box.bottom + 32, "text-anchor": "end" }, names[0]);
  add(svg, "text", { class: "label", x: box.left - 7, y: box.top - 9, "text-anchor": "start" }, names[1]);
  return { toX, toY };
}
