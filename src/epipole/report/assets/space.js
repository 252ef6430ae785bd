/* The 3D view: what is drawn, and from where. Points are drawn in portions, a frame each, as many as the device draws in
   time: they lie in an order drawn at random, so that the first portion, all there is while the eye moves, is a fair
   sample of them, and the rest follows as soon as it rests. */
/* global byId, readJson, cssColor, darkScheme, showTip, fitCanvas, fullScreen */
/* global orbitEye, eyeAt, frameOf, unit, cross, dot, glTarget */
/* global spaceBlocks, spaceLayers, gaussiansOf, gaussianSorter, spaceTools, pickPoint, pickTriangle, pickGaussian */
"use strict";
const SPREAD = 0.75 * Math.tan((25 * Math.PI) / 180); // 50 degrees across an image of 4 : 3
const EVERYWHERE = { low: [-1e30, -1e30, -1e30], high: [1e30, 1e30, 1e30] };
const [FIRST_PORTION, LEAST_PORTION] = [30000, 8000]; // points
const REST_TIMES = 6; // portions a frame when nothing moves
const [QUICK_MS, SLOW_MS] = [22, 33];
const [SWAY, SWAY_MS] = [0.25, 3500]; // radians, milliseconds
const FINE_POINTS = 50000; // of a scene whose lines are worth four samples a pixel

async function spaceView(canvas, data) {
  const say = (text) => {
    byId("no-drawing").textContent = text;
    byId("no-drawing").hidden = !text;
  };
  const countPoints = (isShown) =>
    data.points.reduce((sum, layer, k) => sum + (isShown(layer, k) ? layer.count : 0), 0);
  let total = countPoints((layer) => layer.shown); // those that are to be seen
  const isFine = total < FINE_POINTS && !data.gaussians && !data.live;
  const gl = canvas.getContext("webgl2", {
    alpha: false,
    antialias: isFine,
    depth: true,
    stencil: false,
  });
  if (!gl) {
    say("This browser, or its graphics card, has no WebGL2: the scene cannot be drawn. Another may.");
    return null;
  }
  say("Loading \u2026");
  const late = {
    changed: () => redraw(),
    failed(text) {
      say(text);
      redraw();
    },
  };
  let drawn = null;
  try {
    drawn = spaceLayers(gl, data, await spaceBlocks(data), late);
  } catch (error) {
    say(`The scene cannot be drawn here: ${error.message}.`);
    return null;
  }
  say("");

  const frame = frameOf(data.up),
    settlers = [];
  const look = {
    near: 0.002 * data.radius,
    box: EVERYWHERE,
    pointPx: 2,
    mostRatio: 2, // pixels of the canvas to one of the page
    frustum: 1,
    opacity: 0.5,
    picture: data.cameras && !data.cameras.images ? "depths" : "images", // of the chosen camera
    shown: drawn.shown,
    limits: data.points.map(() => [0, 1, 0, 1]),
    colorBy: 0,
  };
  const target = glTarget(gl);
  let asked = false,
    version = 0, // of what is to be seen
    painted = { version: -1, share: 0, aside: false },
    paintedAt = 0,
    portion = FIRST_PORTION,
    sorted = "",
    fresh = null, // Gaussians that are not sorted yet
    held = null, // those that are being sorted
    chosen = -1,
    hovered = -1;
  /* On a narrow screen from farther away, so that as much is seen across as on one of 4 : 3. */
  function start() {
    const across = Math.max(1, canvas.clientWidth / canvas.clientHeight),
      farther = data.gaussians ? 1 : Math.max(1, 4 / 3 / across);
    const position = data.lookAt.map((v, k) => v + farther * (data.position[k] - v));
    return lookingAt(position, data.lookAt, data.up, SPREAD);
  }
  const view = orbitEye(canvas, {
    start,
    radiusNow: () => data.radius,
    redraw,
    frame,
    wheelAlways: canvas.dataset.whole === "yes",
    reset,
    hover(event) {
      const found = cameraAt(event);
      if (found !== hovered) {
        hovered = found;
        redraw();
      }
      canvas.style.cursor = tools.isMeasuring() ? "crosshair" : found < 0 ? "" : "pointer";
      showTip(event, found < 0 ? "" : data.cameras.names[found]);
    },
    click(event) {
      if (tools.isMeasuring()) return tools.measureAt(event.offsetX, event.offsetY);
      const found = cameraAt(event);
      if (found >= 0) toCamera(found);
    },
    leave(event) {
      hovered = -1;
      showTip(event, "");
      redraw();
    },
  });
  const sorter =
    drawn.gaussians &&
    gaussianSorter((order, count, spent, places) => {
      if (places !== drawn.gaussians.places) drawn.gaussians.drawing.put(Object.assign(drawn.gaussians, held));
      drawn.gaussians.drawing.setOrder(order, count);
      canvas.dataset.sortMs = spent.toFixed(2);
      redraw();
    });
  if (sorter) sorter.hold(drawn.gaussians.places);

  function lookingAt(o, place, up, spread) {
    const away = place.map((v, k) => v - o[k]),
      f = unit(away),
      right = cross(f, up);
    const r = Math.hypot(...right) > 1e-6 * Math.hypot(...up) ? unit(right) : frameOf(f)[0];
    return eyeAt(frame, { o, f, r, dist: Math.hypot(...away), spread });
  }
  const eyeNow = () => ({ basis: view.basis(), focal: view.focal(), near: look.near, box: look.box });

  /* What is begun anew with every change: the ground, triangles and lines. */
  function paintLines(eye, ratio) {
    const gray = data.background,
      ground = cssColor("--stage");
    const back =
      gray === null ? [1, 3, 5].map((k) => parseInt(ground.slice(k, k + 2), 16) / 255) : [gray, gray, gray];
    gl.clearColor(...back, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (drawn.backdrop) {
      gl.disable(gl.DEPTH_TEST);
      drawn.backdrop.drawing.draw(eye, drawn.backdrop);
      gl.enable(gl.DEPTH_TEST);
    }
    if (drawn.mesh && look.shown.mesh) drawn.mesh.drawing.draw(eye);
    const width = 1.6 * ratio;
    for (let k = drawn.curves.length - 1; k >= 0; k--)
      if (look.shown[`curve-${k}`]) drawn.curves[k].draw(eye, { width: 1.3 * width }); // the first on top
    if (drawn.cameras && look.shown.cameras) {
      const scale = data.cameras.size * look.frustum;
      drawn.cameras.drawing.draw(eye, { scale, width, chosen, hovered });
    }
  }
  function paintPoints(eye, ratio, from, to) {
    drawn.points.forEach(({ layer, drawing }, k) => {
      if (!look.shown[`points-${k}`]) return;
      const first = Math.floor(from * layer.count);
      drawing.draw(eye, {
        first,
        count: Math.floor(to * layer.count) - first,
        sizePx: look.pointPx * ratio * view.eye().dist,
        mostPx: 4 * look.pointPx * ratio,
        limits: look.limits[k],
        colorBy: Math.min(look.colorBy, layer.measures.length),
      });
    });
    canvas.dataset.points = Math.floor(to * total);
  }
  function paintPicture(eye) {
    const { places, corners } = drawn.cameras;
    gl.enable(gl.BLEND);
    gl.disable(gl.DEPTH_TEST);
    drawn.picture.drawing.draw(eye, {
      place: places.subarray(3 * chosen, 3 * chosen + 3),
      corners: corners.subarray(12 * chosen, 12 * chosen + 12),
      scale: data.cameras.size * look.frustum,
      opacity: look.opacity,
    });
    gl.disable(gl.BLEND);
  }
  /* The first portion is drawn on the canvas at once; what follows is gathered aside. */
  function paint(eye, ratio, share) {
    const isNew = painted.version !== version;
    if (isNew) painted = { version, share: 0, aside: false };
    else if (isFine) painted.share = 0; // few points: all of them anew
    const until = Math.min(1, painted.share + (isNew ? share : isFine ? 1 : REST_TIMES * share)),
      begins = isNew || isFine || !painted.aside;
    if (isNew || isFine) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.viewport(0, 0, canvas.width, canvas.height);
    } else {
      target.bind(canvas.width, canvas.height);
      painted.aside = true;
    }
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    if (begins) paintLines(eye, ratio);
    if (total) paintPoints(eye, ratio, begins ? 0 : painted.share, until);
    painted.share = until;
    if (until === 1 && sorter && look.shown.gaussians) drawn.gaussians.drawing.draw(eye);
    if (painted.aside) target.show();
    if (drawn.picture.of === chosen && chosen >= 0 && look.opacity > 0) paintPicture(eye);
  }

  /* The whole of it as a PNG; `ready` gets the bytes. */
  function snapshot(ready) {
    version++;
    paint(eyeNow(), canvas.width / canvas.clientWidth, 1);
    canvas.toBlob(ready, "image/png"); // of what was drawn in this very task
  }

  /* Whether the Gaussians are in order for an eye; they will be. */
  function sort({ f, o }) {
    if (sorter.isBusy()) return false;
    const seen = JSON.stringify([f, o]);
    if (seen === sorted) return true;
    sorted = seen;
    if (fresh) sorter.hold((held = fresh).places);
    fresh = null;
    sorter.sort({ f, o, near: look.near });
    return false;
  }
  function draw(now) {
    asked = false;
    const before = `${canvas.width} ${canvas.height}`,
      ratio = fitCanvas(canvas, look.mostRatio),
      eye = eyeNow(),
      spent = now - paintedAt;
    if (before !== `${canvas.width} ${canvas.height}`) version++;
    // Frames that follow each other tell what a portion costs: those of a moving eye alone.
    const isMoving = painted.version !== version;
    if (isMoving && spent > SLOW_MS && spent < 3000) portion = Math.max(LEAST_PORTION, 0.7 * portion);
    if (isMoving && spent < QUICK_MS) portion = Math.min(1.3 * portion, Math.max(total, FIRST_PORTION));
    paintedAt = isMoving ? now : -Infinity;
    const isSorted = !sorter || sort(eye.basis);
    if (isMoving || painted.share < 1) paint(eye, ratio, total ? portion / total : 1);
    tools.mark({ ...eye, dist: view.eye().dist });
    const isComplete = isSorted && painted.share === 1 && (!drawn.mesh || drawn.mesh.drawing.isComplete());
    canvas.dataset.settled = isComplete ? "yes" : "no";
    if (painted.share < 1) ask();
    else if (isComplete) settlers.splice(0).forEach((ready) => ready());
  }
  function ask() {
    if (asked) return;
    asked = true;
    requestAnimationFrame(draw);
  }
  function redraw() {
    canvas.dataset.settled = "no";
    total = countPoints((_, k) => look.shown[`points-${k}`]);
    version++;
    ask();
  }

  /* Replaces the scene by another with the same layers. */
  function update(scene, blocks) {
    drawn.put(scene, blocks);
    if (scene.gaussians) {
      fresh = gaussiansOf(scene.gaussians, blocks);
      sorted = "";
      sort(view.basis()); // and draw once they are
    } else redraw();
    Object.assign(data, scene);
    total = countPoints((_, k) => look.shown[`points-${k}`]);
    look.near = 0.002 * data.radius;
  }
  /* Once all of the scene is drawn, and the graphics card is done with it. */
  async function settled() {
    await new Promise((ready) => {
      settlers.push(ready);
      ask();
    });
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  function cameraAt(event) {
    if (!drawn.cameras || !look.shown.cameras) return -1;
    const { r, d, f, o } = view.basis(),
      focal = (view.focal() * canvas.clientWidth) / canvas.width,
      places = drawn.cameras.places;
    let best = -1,
      nearest = 16;
    for (let k = 0; k < places.length / 3; k++) {
      const ray = [0, 1, 2].map((a) => places[3 * k + a] - o[a]),
        z = dot(f, ray);
      if (!(z > look.near)) continue;
      const away = Math.hypot(
        0.5 * canvas.clientWidth + (focal * dot(r, ray)) / z - event.offsetX,
        0.5 * canvas.clientHeight + (focal * dot(d, ray)) / z - event.offsetY,
      );
      if (away < nearest) {
        nearest = away;
        best = k;
      }
    }
    return best;
  }

  /* The eye of a camera: the whole of its image is seen. */
  function toCamera(k) {
    const { places, axes } = drawn.cameras,
      [width, height] = data.cameras.sizes[k],
      o = Array.from(places.subarray(3 * k, 3 * k + 3)),
      [r, f] = [0, 3].map((q) => Array.from(axes.subarray(6 * k + q, 6 * k + q + 3)));
    const depth = dot(
        f,
        data.lookAt.map((v, a) => v - o[a]),
      ),
      side = Math.min(canvas.width, canvas.height),
      scale = Math.min(canvas.width / width, canvas.height / height);
    chosen = k;
    tools.showCamera(k);
    showPicture(k);
    const spread = (0.5 * side) / (scale * data.cameras.focals[k]);
    view.flyTo(eyeAt(frame, { o, f, r, dist: Math.max(depth, 0.3 * data.radius), spread }));
  }
  function reset() {
    chosen = -1;
    tools.showCamera(-1);
    view.flyTo(start());
  }
  function showPicture(k) {
    const address = (data.cameras[look.picture] || [])[k];
    drawn.picture.of = -1;
    if (!address) return;
    const image = new Image();
    image.onload = () => {
      if (chosen !== k) return;
      drawn.picture.drawing.put(image);
      drawn.picture.of = k;
      redraw();
    };
    image.src = address;
  }
  function stepCamera(step) {
    const count = data.cameras.names.length;
    toCamera(chosen < 0 && step < 0 ? count - 1 : (chosen + step + count) % count);
  }

  /* The nearest place under a pixel of the page: of a triangle, a point or Gaussians. */
  function placeAt(x, y) {
    const basis = view.basis(),
      focal = (view.focal() * canvas.clientWidth) / canvas.width,
      u = (x - 0.5 * canvas.clientWidth) / focal,
      v = (y - 0.5 * canvas.clientHeight) / focal,
      ray = basis.f.map((value, k) => value + u * basis.r[k] + v * basis.d[k]);
    const inside = (place) =>
      [0, 1, 2].every((k) => place[k] >= look.box.low[k] && place[k] <= look.box.high[k]);
    const found = [];
    drawn.points.forEach(({ layer, rows, values, covariances }, k) => {
      if (!look.shown[`points-${k}`]) return;
      const limits = look.limits[k];
      const passes = (row) => {
        const within = (q) => {
          const value = values ? values[2 * row + q] / 65535 : 1;
          return value >= 1 || (value >= limits[2 * q] && value <= limits[2 * q + 1]);
        };
        return within(0) && within(1) && inside(rows.subarray(4 * row, 4 * row + 3));
      };
      const hit = pickPoint(rows, layer.count, basis, u, v, 8 / focal, look.near, passes);
      if (!hit) return;
      const covariance = covariances ? Array.from(covariances.subarray(6 * hit.row, 6 * hit.row + 6)) : null;
      found.push({ ...hit, covariance, errorWords: layer.errorWords });
    });
    if (drawn.mesh && look.shown.mesh)
      found.push(pickTriangle(drawn.mesh.vertices, drawn.mesh.faces, basis.o, ray, inside));
    if (sorter && look.shown.gaussians) {
      const { words, places } = drawn.gaussians;
      const range = drawn.gaussians.numbers.scaleRange;
      found.push(pickGaussian(words, places, range, basis, u, v, focal, look.near, inside));
    }
    return found.filter(Boolean).sort((a, b) => a.depth - b.depth)[0] || null;
  }

  /* #view= position, what is looked at, up, and degrees of the shorter side: ten numbers with commas between. */
  function toViewOfAddress() {
    const numbers = (/^#view=([-+.\deE,]+)$/.exec(location.hash) || ["", ""])[1].split(",").map(Number);
    if (numbers.length !== 10 || !numbers.every(Number.isFinite)) return;
    const inWorld = [0, 3, 6].map((k) => numbers.slice(k, k + 3)),
      up = inWorld[2],
      [position, lookAt] = inWorld.slice(0, 2).map((place) => place.map((v, k) => v - data.origin[k]));
    if (!(numbers[9] > 0 && numbers[9] < 170) || !Math.hypot(...up)) return;
    if (!Math.hypot(...lookAt.map((v, k) => v - position[k]))) return;
    view.jumpTo(lookingAt(position, lookAt, up, Math.tan((numbers[9] * Math.PI) / 360)));
  }

  canvas.addEventListener("dblclick", (event) => {
    const hit = placeAt(event.offsetX, event.offsetY),
      eye = view.eye();
    if (hit && !tools.isMeasuring())
      view.flyTo({ ...eye, focus: hit.place, dist: Math.min(hit.depth, eye.dist) });
  });
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    say("The browser has taken the graphics card away. Load the page again.");
  });
  const tools = spaceTools(canvas, data, {
    look,
    redraw,
    placeAt,
    stepCamera,
    changePicture(kind) {
      look.picture = kind;
      tools.showCamera(chosen);
      if (chosen >= 0) showPicture(chosen);
      redraw();
    },
    reset,
    above() {
      const o = data.lookAt.map((v, k) => v + 3 * data.radius * frame[2][k]),
        r = data.isEnu ? [1, 0, 0] : frame[0]; // north is at the top, as in maps
      view.flyTo(
        eyeAt(frame, { o, f: frame[2].map((v) => -v), r, dist: 3 * data.radius, spread: SPREAD }),
      );
    },
    snapshot,
  });
  /* A page that is one 3D view shows its depth at the start: a slow turn to one side and back, until a hand takes over. */
  function sway() {
    const from = start(),
      aside = { ...from, yaw: from.yaw + SWAY };
    if (canvas.dataset.whole !== "yes" || data.live || /^#view=/.test(location.hash)) return;
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) return;
    view.flyTo(aside, { ms: SWAY_MS, then: () => view.flyTo(from, { ms: SWAY_MS }) });
  }
  addEventListener("hashchange", toViewOfAddress);
  new ResizeObserver(redraw).observe(canvas);
  darkScheme.addEventListener("change", redraw);
  toViewOfAddress();
  redraw();
  sway();
  return {
    ...{ gl, data, view, drawn, look, placeAt, toCamera, tools, snapshot, redraw, update, settled, start },
    portion: () => portion,
    chosen: () => chosen,
  };
}

const space = byId("space") ? spaceView(byId("space"), readJson("space-data")) : null;
