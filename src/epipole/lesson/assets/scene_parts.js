/* What several figures in three dimensions share: the house, rays that go on behind a camera, and images below the figure. */
/* exported putHouse, putRay, putImage, insets, enlarge, insetMark, insetHouse */

function putHouse(put, corners, edges, kind = "house") {
  for (const [a, b] of edges) put.line(corners[a], corners[b], kind);
}

/* A ray from a center along a direction: solid ahead of the camera, dashed behind it, in units of the direction. */
function putRay(put, center, direction, kind, ahead, behind = 0) {
  put.line(center, plus(center, scaled(direction, ahead)), `ray ${kind}`);
  if (behind > 0) put.line(center, plus(center, scaled(direction, -behind)), `dashed ${kind}`);
}

/* The image of a point on the image plane that `put.camera` draws at this distance. */
function putImage(put, motion, point, kind, size) {
  const [x, y, z] = moved(motion, point);
  put.dot(moved(inverseMotion(motion), [(size * x) / z, (size * y) / z, size]), kind, 4.5);
}

/* Images beside each other in a drawing of their own, each with its name; a single one is at most 420 wide. */
function insets(id, names) {
  const count = names.length,
    side = (width) => (count === 1 ? Math.min(width - 24, 420) : (width - 12) / count - 12);
  const [svg, width] = fitted(id, (all) => 0.75 * side(all) + 42);
  const start = count === 1 ? (width - side(width)) / 2 : 12;
  return names.map((name, k) => {
    const inside = picture(svg, start + k * (side(width) + 12), 30, side(width), name);
    inside.classList.add("inset");
    inside.dataset.unit = String(640 / side(width)); // pixels of the image in a unit of the drawing
    return inside;
  });
}

/* Show another part of the image plane in an inset, around a pixel, this many pixels wide. */
function enlarge(inside, [u, v], width) {
  inside.setAttribute("viewBox", `${u - width / 2} ${v - 0.375 * width} ${width} ${0.75 * width}`);
  const frame = inside.querySelector(".frame");
  for (const [name, value] of Object.entries({ x: u - width / 2, y: v - 0.375 * width, width, height: 0.75 * width }))
    frame.setAttribute(name, value);
  inside.dataset.unit = String((Number(inside.dataset.unit) * width) / 640);
}

/* A mark of the same size in every inset. */
function insetMark(inside, [x, y], kind, size = 5) {
  const r = size * Number(inside.dataset.unit);
  if (kind.startsWith("cross")) add(inside, "path", { class: kind, d: `M${x - r},${y} h${2 * r} M${x},${y - r} v${2 * r}` });
  else add(inside, "circle", { class: kind, cx: x, cy: y, r });
}

function insetHouse(inside, corners, edges, motion) {
  const seen = corners.map((corner) => project(moved(motion, corner)));
  for (const [a, b] of edges)
    add(inside, "line", { class: "house", x1: seen[a][0], y1: seen[a][1], x2: seen[b][0], y2: seen[b][1] });
}
