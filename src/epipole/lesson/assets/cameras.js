/* The camera of the pages, and pictures of it: 640 x 480 pixels, the center of the first at (0, 0). */
/* exported K, K_INVERSE, pixelOf, project, rayOf, picture, twoPictures, matrixTable, degrees */
const K = [
  [520, 0, 319.5],
  [0, 520, 239.5],
  [0, 0, 1],
];
const K_INVERSE = inverted(K);
const pixelOf = ([x, y, w]) => [x / w, y / w];
const project = (point) => pixelOf(applied(K, point));
const rayOf = ([u, v]) => applied(K_INVERSE, [u, v, 1]);
const degrees = (angle) => (angle * Math.PI) / 180;

/* A picture in a drawing, from (x, y), so wide; what is drawn in it is cut at its rim. */
function picture(svg, x, y, width, name) {
  const height = 0.75 * width;
  add(svg, "text", { class: "label", x, y: y - 7 }, name);
  const inside = add(svg, "svg", { x, y, width, height, viewBox: "-0.5 -0.5 640 480", class: "picture" });
  add(inside, "rect", { class: "frame", x: -0.5, y: -0.5, width: 640, height: 480 });
  return inside;
}

/* Two pictures beside each other, on a phone with less room around them: [first, second]. */
function twoPictures(id, names) {
  const edge = (width) => (width < 600 ? 2 : 12),
    gap = (width) => (width < 600 ? 8 : 20),
    side = (width) => (width - 2 * edge(width) - gap(width)) / 2;
  const [svg, width] = fitted(id, (all) => 0.75 * side(all) + 44);
  return names.map((name, k) => picture(svg, edge(width) + k * (side(width) + gap(width)), 30, side(width), name));
}

/* A matrix as a table. */
function matrixTable(id, A, digits = 3) {
  const rows = A.map((row) => {
    const tr = document.createElement("tr");
    for (const value of row) {
      const cell = document.createElement("td");
      cell.textContent = shownNumber(value, digits);
      cell.dataset.value = String(value);
      tr.append(cell);
    }
    return tr;
  });
  byId(id).replaceChildren(...rows);
}
