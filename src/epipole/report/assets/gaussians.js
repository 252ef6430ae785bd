/* The page of Gaussians: from where they are seen, and when they are sorted and drawn. */
/* global byId, readJson, bytesOf, fitCanvas, orbitEye, eyeAt, frameOf, unit, fullScreen, cross, dot */
/* global gaussianDrawing, gaussianSorter */
"use strict";
const USUAL_SPREAD = 0.75 * Math.tan((25 * Math.PI) / 180); // 50 degrees across a picture of 4 : 3

function gaussianView(canvas, data) {
  const wordsOf = (id) => (byId(id) ? new Uint32Array(bytesOf(byId(id).textContent).buffer) : null);
  const say = (text) => {
    byId("no-drawing").textContent = text;
    byId("no-drawing").hidden = false;
  };
  const words = wordsOf("gaussians"),
    floats = new Float32Array(words.buffer),
    places = new Float32Array(3 * data.count);
  for (let k = 0; k < data.count; k++) places.set(floats.subarray(8 * k, 8 * k + 3), 3 * k);
  let drawing = null;
  try {
    drawing = gaussianDrawing(canvas, data, words, wordsOf("harmonics"));
  } catch (error) {
    return say(`The Gaussians cannot be drawn here: ${error.message}.`);
  }
  if (!drawing) {
    return say(
      "This browser, or its graphics card, has no WebGL2: the Gaussians cannot be drawn. Another may.",
    );
  }

  const frame = frameOf(data.up),
    between = data.lookAt.map((v, k) => v - data.position[k]),
    radius = Math.hypot(...between),
    near = 0.002 * radius;
  let asked = false,
    sorted = "",
    camera = -1;
  const view = orbitEye(canvas, {
    start: () => lookingAt(data.position, data.lookAt, data.up, USUAL_SPREAD),
    radius,
    redraw,
    frame,
    keys: document,
    wheelAlways: true,
  });
  const sorter = gaussianSorter(places, (order, count, spent) => {
    drawing.setOrder(order, count);
    canvas.dataset.sortMs = spent.toFixed(2);
    redraw();
  });

  function lookingAt(o, place, up, spread) {
    const away = place.map((v, k) => v - o[k]),
      f = unit(away),
      right = cross(f, up);
    const r = Math.hypot(...right) > 1e-6 * Math.hypot(...up) ? unit(right) : frameOf(f)[0];
    return eyeAt(frame, { o, f, r, dist: Math.hypot(...away), spread });
  }

  function draw() {
    asked = false;
    fitCanvas(canvas, 2);
    const basis = view.basis(),
      seen = JSON.stringify([basis.f, basis.o]);
    if (seen !== sorted && !sorter.isBusy()) {
      sorted = seen;
      sorter.sort({ f: basis.f, o: basis.o, near });
    }
    drawing.draw(basis, view.focal(), near);
    canvas.dataset.settled = seen === sorted && !sorter.isBusy() ? "yes" : "no";
  }
  function redraw() {
    canvas.dataset.settled = "no";
    if (!asked) {
      asked = true;
      requestAnimationFrame(draw);
    }
  }

  /* The eye of a picture: the whole of it is seen. */
  function eyeOfCamera({ position, right, ahead, focal, size }) {
    const [width, height] = size,
      scale = Math.min(canvas.width / width, canvas.height / height);
    const depth = dot(
      ahead,
      data.lookAt.map((v, k) => v - position[k]),
    );
    return eyeAt(frame, {
      o: position,
      f: ahead,
      r: right,
      dist: Math.max(depth, 0.3 * radius),
      spread: (0.5 * Math.min(canvas.width, canvas.height)) / (scale * focal),
    });
  }
  function toCamera(step) {
    const count = data.cameras.length;
    camera = camera < 0 && step < 0 ? count - 1 : (camera + step + count) % count;
    byId("camera-name").textContent = `${camera + 1} of ${count}: ${data.cameras[camera].name}`;
    view.flyTo(eyeOfCamera(data.cameras[camera]));
  }

  /* The mean of the three deviations' logarithms, as a length. */
  function sizeOf(k) {
    const third = words[8 * k + 6],
      sum = (third & 65535) + (third >>> 16) + (words[8 * k + 7] & 65535);
    return Math.exp(data.scaleRange[0] + (data.scaleRange[1] * sum) / (3 * 65535));
  }
  /* The depth at which half of the light from a pixel is held up by Gaussians, taken to be round: what is there becomes
     the middle. */
  function lookAtPixel(event) {
    const { r, d, f, o } = view.basis(),
      ratio = canvas.width / canvas.clientWidth,
      focal = view.focal() / ratio;
    const x = (event.offsetX - 0.5 * canvas.clientWidth) / focal,
      y = (event.offsetY - 0.5 * canvas.clientHeight) / focal;
    const hits = [];
    for (let k = 0, q = 0; k < data.count; k++, q += 3) {
      const ray = [places[q] - o[0], places[q + 1] - o[1], places[q + 2] - o[2]],
        z = dot(f, ray);
      if (!(z > near)) continue;
      const off = Math.hypot(dot(r, ray) / z - x, dot(d, ray) / z - y),
        ratio2 = off ** 2 / ((3 / focal) ** 2 + (sizeOf(k) / z) ** 2);
      if (ratio2 < 9) hits.push([z, ((words[8 * k + 7] >>> 16) / 65535) * Math.exp(-0.5 * ratio2)]);
    }
    let through = 1;
    for (const [z, held] of hits.sort((a, b) => a[0] - b[0])) {
      through *= 1 - held;
      if (through < 0.5) {
        const place = o.map((v, k) => v + z * (f[k] + x * r[k] + y * d[k])),
          eye = view.eye();
        return view.flyTo({ ...eye, focus: place, dist: Math.min(z, eye.dist) });
      }
    }
  }

  /* #view= position, what is looked at, up, and degrees of the shorter side: ten numbers with commas between. */
  function toViewOfAddress() {
    const numbers = (/^#view=([-+.\deE,]+)$/.exec(location.hash) || ["", ""])[1].split(",").map(Number);
    if (numbers.length !== 10 || !numbers.every(Number.isFinite)) return;
    const [position, lookAt, up] = [0, 3, 6].map((k) => numbers.slice(k, k + 3));
    if (!(numbers[9] > 0 && numbers[9] < 170) || !Math.hypot(...up)) return;
    if (!Math.hypot(...lookAt.map((v, k) => v - position[k]))) return;
    view.jumpTo(lookingAt(position, lookAt, up, Math.tan((numbers[9] * Math.PI) / 360)));
  }

  canvas.addEventListener("dblclick", lookAtPixel);
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    say("The browser has taken the graphics card away. Load the page again.");
  });
  byId("reset-view").addEventListener("click", () => {
    camera = -1;
    if (byId("camera-name")) byId("camera-name").textContent = "";
    view.flyTo(lookingAt(data.position, data.lookAt, data.up, USUAL_SPREAD));
  });
  if (data.cameras.length) {
    byId("next-camera").addEventListener("click", () => toCamera(1));
    byId("last-camera").addEventListener("click", () => toCamera(-1));
  }
  byId("full-screen").hidden = !document.fullscreenEnabled;
  byId("full-screen").addEventListener("click", () => fullScreen(canvas.parentElement));
  addEventListener("hashchange", toViewOfAddress);
  new ResizeObserver(redraw).observe(canvas);
  toViewOfAddress();
  redraw();
  return { view, drawing, sorter };
}
const gaussians = gaussianView(byId("space"), readJson("scene"));
