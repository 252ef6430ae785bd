/* The four motions that an essential matrix leaves, and how many points lie before both cameras in each. */
/* Both turns and the direction of E, without a decomposition into singular values (Horn, Recovering baseline and orientation
   from essential matrix, 1990): with |t| = 1 the cofactors of E less or more [t]x E are turns. */
function candidatesOf(E) {
  const [a, b, c] = transposed(E);
  const products = [cross(a, b), cross(b, c), cross(c, a)];
  const t = unit(products.reduce((best, one) => (norm(one) > norm(best) ? one : best)));
  const size = Math.sqrt(0.5 * E.flat().reduce((sum, v) => sum + v * v, 0));
  const sized = E.map((row) => scaled(row, 1 / size));
  const cofactors = [cross(sized[1], sized[2]), cross(sized[2], sized[0]), cross(sized[0], sized[1])];
  const across = times(skew(t), sized);
  const turns = [-1, 1].map((sign) => cofactors.map((row, i) => plus(row, scaled(across[i], sign))));
  // In an order that stays while the motion changes: the smaller turn first, and of each the direction to the right first.
  const right = t[0] < 0 ? scaled(t, -1) : t;
  turns.sort((one, other) => angleOf(one) - angleOf(other));
  return turns.flatMap((R) => [right, scaled(right, -1)].map((direction) => ({ R, t: direction })));
}

function candidateNumbers({ tx, tz, yaw, far, noise }) {
  const truth = motionOf({ tx, tz, yaw });
  const corners = SCENE.corners.map(([x, y, z]) => [x, y, z - 5 + far]);
  const seen = (motion, k) =>
    corners.map((corner, j) => rayOf(plus(project(moved(motion, corner)), scaled(SCENE.noise[k][j], noise))));
  const rays1 = seen(HERE, 0),
    rays2 = seen(truth, 1);
  const found = candidatesOf(times(skew(truth.t), truth.R)).map((motion) => {
    const points = rays1.map((ray, j) => triangulated(motion, ray, rays2[j]));
    const isTrue = angleOf(times(motion.R, transposed(truth.R))) < 1 && dot(motion.t, truth.t) > 0;
    return { motion, points, isTrue, count: points.filter((p) => p.along1 > 0 && p.along2 > 0).length };
  });
  const most = Math.max(...found.map(({ count }) => count));
  return found.map((one) => ({ ...one, isChosen: one.count === most }));
}

/* A point, or at the rim an arrow to where it is. */
function drawPoint(inside, [x, y], kind) {
  if (!Number.isFinite(x)) return;
  if (Math.abs(x) < 100 && Math.abs(y) < 205) {
    add(inside, "circle", { class: kind, cx: x, cy: y, r: 5 });
    return;
  }
  const shrink = Math.min(97 / Math.abs(x), 202 / Math.abs(y)),
    turned = (Math.atan2(y, x) * 180) / Math.PI;
  add(inside, "path", {
    class: kind,
    d: "M0,0 l-9,-5 v10 z",
    transform: `translate(${shrink * x} ${shrink * y}) rotate(${turned})`,
  });
}

function drawFour(found) {
  const gap = (width) => (width < 600 ? 6 : 12),
    above = (width) => (width < 600 ? 46 : 34),
    side = (width) => (width - gap(width)) / 4 - gap(width);
  const [svg, width] = fitted("four", (all) => 2 * side(all) + above(all) + 12);
  const wide = side(width);
  found.forEach(({ motion, points, count, isTrue, isChosen }, k) => {
    const left = gap(width) + (wide + gap(width)) * k,
      top = above(width),
      inside = add(svg, "svg", {
        x: left,
        y: top,
        width: wide,
        height: 2 * wide,
        viewBox: "-105 -210 210 420",
      });
    const truth = isTrue ? ` (${WORDS.true})` : "",
      label = (text, y) => add(svg, "text", { class: "label", x: left, y }, text);
    if (width < 600) {
      label(`${"ABCD"[k]}: ${count}`, top - 26);
      label(truth.trim(), top - 8);
    } else label(`${WORDS.candidate} ${"ABCD"[k]}: ${count}${truth}`, top - 8);
    add(inside, "rect", {
      class: isChosen ? "frame chosen" : "frame",
      x: -104,
      y: -209,
      width: 208,
      height: 418,
    });
    const reach = Math.max(...points.map(({ point }) => Math.abs(point[2])).filter((z) => z < 60), 3),
      scale = 195 / (reach + 1);
    const toPlace = ([x, , z]) => [scale * x, -scale * z];
    for (const { point, along1, along2 } of points)
      drawPoint(inside, toPlace(point), along1 > 0 && along2 > 0 ? "object" : "behind");
    drawCamera(inside, toPlace, HERE, "one");
    drawCamera(inside, toPlace, motion, "other");
  });
}

watch(["tx", "tz", "yaw", "far", "noise"], (values) => {
  const found = candidateNumbers(values);
  found.forEach(({ motion, count, isTrue, isChosen }, k) => {
    byId(`row${k}`).className = isChosen ? "best" : "";
    byId(`true${k}`).textContent = isTrue ? WORDS.true : "";
    show(`angle${k}`, angleOf(motion.R), "°");
    motion.t.forEach((v, axis) => show(`t${k}${axis}`, v));
    showCount(`count${k}`, count);
  });
  drawFour(found);
  const [a, b, c, d] = found.map(({ count }) => count);
  told("four-told", WORDS.four_told, { all: SCENE.corners.length, a, b, c, d }, ["all", "a", "b", "c", "d"]);
});
