/* The small figures of the page on disparity: one ray, two similar triangles, disparity against depth. */

/* From above: a camera at (x, y) that looks up, and its image plane. */
function drawUpward(svg, x, y, plane, kind, half = 90) {
  add(svg, "line", { class: `measure ${kind}`, x1: x - half, x2: x + half, y1: y - plane, y2: y - plane });
  add(svg, "line", { class: "dashed", x1: x, x2: x, y1: y, y2: y - plane - 24 });
  add(svg, "circle", { class: kind, cx: x, cy: y, r: 6 });
}

/* All points (tX, tZ) of a ray have one pixel: t cancels. */
watch(["t"], ({ t }) => {
  const [svg, width] = fitted("ray", 280),
    x = width / 2 - 90,
    [bottom, plane, X, Z, f] = [258, 60, 0.12, 0.5, 800];
  const at = (times) => [x + 78 * times * 0.48, bottom - 78 * times * 0.5];
  add(svg, "line", { class: "ray one", x1: x, y1: bottom, x2: at(6.6)[0], y2: at(6.6)[1] });
  drawUpward(svg, x, bottom, plane, "one");
  const mark = x + (plane * 0.48) / 0.5;
  for (const k of [2, 3, 4, 5, 6]) {
    const [cx, cy] = at(k);
    add(svg, "circle", { class: "behind", cx, cy, r: 4 });
  }
  const [cx, cy] = at(t);
  add(svg, "circle", { class: "object", cx, cy, r: 8 });
  add(svg, "circle", { class: "point", cx: mark, cy: bottom - plane, r: 6 });
  const point = `(${shownNumber(t * X, 2)} m, ${shownNumber(t * Z, 2)} m)`;
  add(svg, "text", { class: "label", x: cx + 14, y: cy + 5 }, point);
  const pixel = `x = ${shownNumber((f * t * X) / (t * Z), 3)} ${WORDS.unit_px}`;
  add(svg, "text", { class: "label point", x: mark + 14, y: bottom - plane + 18 }, pixel);
  told("ray-told", WORDS.ray_told, { x: t * X, z: t * Z, pixel: (f * X) / Z });
});

/* Two cameras: in each, the triangle before the image plane is like the one up to the object. */
watch(["Zt", "Bt"], ({ Zt, Bt }) => {
  const [svg, width] = fitted("triangles", 320),
    [bottom, plane] = [292, 66],
    perMeter = Math.min(150, (width - 190) / 1.4);
  const left = width / 2 - 0.7 * perMeter + 20,
    right = left + perMeter * Bt,
    far = bottom - 66 * Zt,
    object = left + 0.55 * perMeter;
  [left, right].forEach((x, k) => {
    const kind = ["one", "other"][k],
      shift = ((object - x) * plane) / (bottom - far);
    add(svg, "polygon", { class: `sheet ${kind}`, points: `${x},${bottom} ${x},${far} ${object},${far}` });
    add(svg, "line", { class: `ray ${kind}`, x1: x, y1: bottom, x2: object, y2: far });
    drawUpward(svg, x, bottom, plane, kind, 52);
    add(svg, "line", { class: `thick ${kind}`, x1: x, x2: x + shift, y1: bottom - plane, y2: bottom - plane });
    const shown = `${k ? "xR" : "xL"} = ${shownNumber((WORKED.f * (0.55 - k * Bt)) / Zt, 3)} ${WORDS.unit_px}`;
    add(svg, "text", { class: `label ${kind}`, x: 12, y: 24 + 20 * k }, shown);
  });
  add(svg, "line", { class: "measure", x1: left, x2: right, y1: bottom, y2: bottom });
  add(svg, "text", { class: "label", x: (left + right) / 2, y: bottom + 20, "text-anchor": "middle" }, "B");
  add(svg, "circle", { class: "object", cx: object, cy: far, r: 7 });
  const d = disparityOf(Zt, WORKED.f, Bt);
  add(svg, "text", { class: "label", x: 12, y: 64 }, `d = xL − xR = ${shownNumber(d, 3)} ${WORDS.unit_px}`);
  told("triangles-told", WORDS.triangles_told, { Z: Zt, B: Bt, d });
});

/* Disparity against depth, on a scale that stays. */
const SHIFT = { depth: 40, disparity: 200 };

function disparityPath(B, toX, toY) {
  const first = (WORKED.f * B) / SHIFT.disparity;
  const at = (z) => `${toX(z).toFixed(1)},${toY(disparityOf(z, WORKED.f, B)).toFixed(1)}`;
  return "M" + Array.from({ length: 161 }, (_, k) => at(first * (SHIFT.depth / first) ** (k / 160))).join(" L");
}

watch(["Zd", "Bd"], ({ Zd, Bd }) => {
  const [svg, width] = fitted("shift", 270),
    box = { left: 52, top: 28, right: width - 16, bottom: 222 };
  const { toX, toY } = chartAxes(svg, box, [SHIFT.depth, SHIFT.disparity], [WORDS.depth_axis, WORDS.disparity_axis]);
  const d = disparityOf(Zd, WORKED.f, Bd),
    [x, y] = [toX(Zd), toY(Math.min(d, SHIFT.disparity))];
  add(svg, "path", { class: "before", d: disparityPath(WORKED.B, toX, toY) });
  add(svg, "path", { class: "series accent", d: disparityPath(Bd, toX, toY) });
  add(svg, "path", { class: "mark", d: `M${x},${box.bottom} V${y} H${box.left}` });
  add(svg, "circle", { class: "object", cx: x, cy: y, r: 7 });
  const side = x > width - 190 ? { x: x - 12, "text-anchor": "end" } : { x: x + 12 };
  const label = `d = ${shownNumber(d, 3)} ${WORDS.unit_px}, Z = ${withUnit(Zd, "m")}`;
  add(svg, "text", { class: "label", y: Math.max(y - 10, box.top + 12), ...side }, label);
  told("shift-told", WORDS.shift_told, { Z: Zd, d });
});
document.documentElement.dataset.ready = "yes";
