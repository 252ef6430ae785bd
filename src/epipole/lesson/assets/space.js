/* A figure in three dimensions, as SVG: lines, areas, points and words, seen from a viewpoint that a hand or the arrow keys move. */
/* exported space */

/* The figure `id`. `look` has the point in the middle of the view, the distance of the viewpoint from it, and its yaw and
   pitch in radians; y is down, z ahead, as in a camera. The answer is called with a function that puts things in the scene. */
function space(id, look, height = 320) {
  const svg = byId(id),
    eye = { yaw: look.yaw, pitch: look.pitch };
  let scene = () => {};

  function frame() {
    const tall = (width) => height * Math.min(1, Math.max(0.75, width / 560));
    const [, width] = fitted(id, tall),
      items = [];
    const turn = times(rotationOf([eye.pitch, 0, 0]), rotationOf([0, -eye.yaw, 0])),
      focal = (look.zoom || 1) * Math.min(width, 560);
    const seen = (point) => {
      const [x, y, z] = plus(applied(turn, minus(point, look.center)), [0, 0, look.distance]);
      return [width / 2 + (focal * x) / z, tall(width) / 2 + (focal * y) / z, z];
    };
    scene(collector(items, seen, width));
    items.sort((one, other) => other.depth - one.depth);
    for (const { kind, attributes, text } of items) add(svg, kind, attributes, text);
  }

  turnedByHand(svg, eye, frame);
  addEventListener("resize", frame);
  return (draw) => {
    scene = draw;
    frame();
  };
}

/* What a scene is made of; each item has the depth at which it is drawn, far ones first. */
function collector(items, seen, width) {
  const mean = (places) => places.reduce((sum, [, , z]) => sum + z, 0) / places.length;
  const flat = (places) => places.map(([x, y]) => `${x.toFixed(1)},${y.toFixed(1)}`).join(" ");
  const put = {
    line(a, b, kind, extra = {}) {
      const [[x1, y1, z1], [x2, y2, z2]] = [seen(a), seen(b)];
      items.push({ kind: "line", depth: (z1 + z2) / 2, attributes: { class: kind, x1, y1, x2, y2, ...extra } });
    },
    area(points, kind) {
      const places = points.map(seen);
      items.push({ kind: "polygon", depth: mean(places) + 0.01, attributes: { class: kind, points: flat(places) } });
    },
    dot(point, kind, r = 5) {
      const [cx, cy, depth] = seen(point);
      items.push({ kind: "circle", depth: depth - 0.05, attributes: { class: kind, cx, cy, r } });
    },
    /* Words beside a point, inside the drawing. */
    label(point, text, dx = 9, dy = 4) {
      const [x, y] = seen(point),
        length = [...text].reduce((sum, letter) => sum + (letter > "\u2e80" ? 14 : 7.5), 0);
      const start = dx > 0 && x + dx + length > width ? x - dx - length : x + dx;
      const inside = Math.max(4, Math.min(start, width - 4 - length));
      items.push({ kind: "text", depth: 0, text, attributes: { class: "label strong", x: inside, y: y + dy } });
    },
    /* A camera: its center, and its image plane at the distance `size`. */
    camera({ R, t }, kind, size = 0.6) {
      const back = inverseMotion({ R, t }),
        corner = ([x, y]) => moved(back, scaled([x, y, 1], size));
      const rim = [[-0.6, -0.45], [0.6, -0.45], [0.6, 0.45], [-0.6, 0.45]].map(corner);
      put.area(rim, `plane ${kind}`);
      rim.forEach((point, k) => {
        put.line(point, rim[(k + 1) % 4], `rim ${kind}`);
        put.line(back.t, point, `rim ${kind}`);
      });
      put.dot(back.t, kind, 4);
    },
  };
  return put;
}

/* A drag turns the view (a finger: sideways; up and down it scrolls the page), and so do the arrow keys. */
function turnedByHand(svg, eye, frame) {
  svg.tabIndex = 0;
  svg.style.touchAction = "pan-y";
  svg.classList.add("draggable");
  const turn = (dx, dy) => {
    eye.yaw += dx;
    eye.pitch = Math.min(1.5, Math.max(-1.5, eye.pitch + dy));
    frame();
  };
  svg.addEventListener("pointerdown", (event) => svg.setPointerCapture(event.pointerId));
  svg.addEventListener("pointermove", (event) => {
    if (svg.hasPointerCapture(event.pointerId)) turn(0.008 * event.movementX, -0.008 * event.movementY);
  });
  svg.addEventListener("keydown", (event) => {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!way) return;
    event.preventDefault();
    turn(0.1 * way[0], 0.1 * way[1]);
  });
}
