/* The 3D view: points splatted into pixels with a depth buffer, frusta as lines. No WebGL. */
/* global byId, readJson, bytesOf, cssColour, darkScheme, NAMES, showTip, fitCanvas, orbitEye, fullScreen */
"use strict";
function spaceView(canvas, data) {
  const n = data.count,
    steps = new Uint16Array(bytesOf(data.xyz).buffer),
    rgb = bytesOf(data.rgb);
  const points = new Float32Array(3 * n),
    colours = new Uint32Array(n);
  for (let k = 0; k < 3 * n; k++) points[k] = data.low[k % 3] + (steps[k] / 65535) * data.span[k % 3];
  const packed = (r, g, b) => (0xff000000 | (b << 16) | (g << 8) | r) >>> 0;
  for (let k = 0; k < n; k++) colours[k] = packed(rgb[3 * k], rgb[3 * k + 1], rgb[3 * k + 2]);
  const cameras = data.centers.map((center, k) => ({
    center,
    corners: data.corners[k],
    name: NAMES[data.image[k]],
  }));
  const curves = data.curves || [],
    curveBoxes = [...document.querySelectorAll(".show-curve")];
  const pen = canvas.getContext("2d");
  const start = () => ({
    focus: data.focus.slice(),
    yaw: 0.9,
    pitch: -0.55,
    roll: 0,
    dist: 2.2 * data.radius,
    spread: 0.5 / 1.15,
  });
  let hovered = -1,
    asked = false,
    pixels = null,
    depth = null;
  const { basis, focal, eye, flyTo } = orbitEye(canvas, {
    start,
    radius: data.radius,
    redraw,
    hover(event) {
      const found = cameraAt(event);
      if (found !== hovered) {
        hovered = found;
        redraw();
      }
      canvas.style.cursor = found < 0 ? "" : "pointer";
      showTip(event, found < 0 ? "" : cameras[found].name);
    },
    click(event) {
      const found = cameraAt(event);
      if (found >= 0) lookFrom(cameras[found]);
    },
    leave(event) {
      hovered = -1;
      showTip(event, "");
      redraw();
    },
  });

  function toView(b, p) {
    const [x, y, z] = p.map((v, k) => v - b.o[k]);
    return [b.r, b.d, b.f].map((axis) => axis[0] * x + axis[1] * y + axis[2] * z);
  }
  function toPixel(v) {
    return [canvas.width / 2 + (focal() * v[0]) / v[2], canvas.height / 2 + (focal() * v[1]) / v[2]];
  }

  function drawPoints(b, ratio) {
    const w = canvas.width,
      h = canvas.height,
      F = focal();
    if (!pixels || pixels.width !== w || pixels.height !== h) {
      pixels = pen.createImageData(w, h);
      depth = new Float32Array(w * h);
    }
    const out = new Uint32Array(pixels.data.buffer),
      ground = cssColour("--stage");
    out.fill(packed(...[1, 3, 5].map((k) => parseInt(ground.slice(k, k + 2), 16))));
    depth.fill(0);
    const size = Number(byId("point-size").value) * ratio * eye().dist,
      near = 0.01 * data.radius;
    const [r0, r1] = b.r,
      [d0, d1, d2] = b.d,
      [f0, f1, f2] = b.f,
      [ox, oy, oz] = b.o;
    for (let k = 0, q = 0; k < n; k++, q += 3) {
      const x = points[q] - ox,
        y = points[q + 1] - oy,
        z = points[q + 2] - oz;
      const zc = f0 * x + f1 * y + f2 * z;
      if (zc < near) continue;
      const inverse = 1 / zc;
      const u = w / 2 + F * (r0 * x + r1 * y) * inverse,
        v = h / 2 + F * (d0 * x + d1 * y + d2 * z) * inverse;
      const s = Math.max(1, Math.min(9, Math.round(size * inverse)));
      const left = Math.round(u - s / 2),
        top = Math.round(v - s / 2);
      if (left < 0 || top < 0 || left + s > w || top + s > h) continue;
      const colour = colours[k];
      for (let row = top; row < top + s; row++) {
        for (let at = row * w + left, end = at + s; at < end; at++) {
          if (inverse > depth[at]) {
            depth[at] = inverse;
            out[at] = colour;
          }
        }
      }
    }
    pen.putImageData(pixels, 0, 0);
  }

  function drawFrusta(b, ratio) {
    const size = data.size * Number(byId("frustum-size").value),
      near = 0.01 * data.radius;
    cameras.forEach((camera, k) => {
      const apex = toView(b, camera.center),
        c = camera.corners,
        o = camera.center;
      const corner = [0, 3, 6, 9].map((q) =>
        toView(
          b,
          [0, 1, 2].map((a) => o[a] + size * c[q + a]),
        ),
      );
      const all = [apex, ...corner];
      if (all.some((v) => v[2] < near)) return;
      const [p, a, e, g, i] = all.map(toPixel);
      pen.strokeStyle = k === hovered ? "#ffd34d" : "#8fd0e6";
      pen.globalAlpha = k === hovered ? 1 : 0.8;
      pen.lineWidth = (k === hovered ? 2.2 : 1) * ratio;
      pen.beginPath();
      for (const q of [a, e, g, i]) {
        pen.moveTo(...p);
        pen.lineTo(...q);
      }
      pen.moveTo(...a);
      pen.lineTo(...e);
      pen.lineTo(...g);
      pen.lineTo(...i);
      pen.closePath();
      pen.stroke();
      pen.fillStyle = pen.strokeStyle;
      pen.globalAlpha = 0.18;
      pen.beginPath();
      pen.moveTo(...a);
      pen.lineTo(...e);
      pen.lineTo(...g);
      pen.lineTo(...i);
      pen.fill();
    });
    pen.globalAlpha = 1;
  }

  function drawCurves(b, ratio) {
    const near = 0.01 * data.radius;
    for (let k = curves.length - 1; k >= 0; k--) {
      const curve = curves[k]; // the first on top
      if (!curveBoxes[k].checked) continue;
      pen.strokeStyle = curve.rgb;
      pen.lineWidth = 1.8 * ratio;
      pen.lineCap = "round";
      pen.beginPath();
      for (let q = 0; q < curve.xyz.length; q += 6) {
        const ends = [curve.xyz.slice(q, q + 3), curve.xyz.slice(q + 3, q + 6)].map((p) => toView(b, p));
        if (ends.some((v) => v[2] < near)) continue;
        pen.moveTo(...toPixel(ends[0]));
        pen.lineTo(...toPixel(ends[1]));
      }
      pen.stroke();
    }
  }

  function drawTriad(b, ratio) {
    const x = 38 * ratio,
      y = canvas.height - 38 * ratio,
      reach = 24 * ratio;
    pen.font = `${12 * ratio}px system-ui, sans-serif`;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.lineWidth = 1.4 * ratio;
    [
      ["x", "#e08a80"],
      ["y", "#8cc48c"],
      ["z", "#8fb0ec"],
    ].forEach(([label, colour], k) => {
      const dx = b.r[k] * reach,
        dy = b.d[k] * reach;
      pen.strokeStyle = pen.fillStyle = colour;
      pen.beginPath();
      pen.moveTo(x, y);
      pen.lineTo(x + dx, y + dy);
      pen.stroke();
      pen.fillText(label, x + dx * 1.38, y + dy * 1.38);
    });
  }

  function draw() {
    asked = false;
    const ratio = fitCanvas(canvas, 2),
      b = basis();
    drawPoints(b, ratio);
    if (byId("show-cameras").checked) drawFrusta(b, ratio);
    drawCurves(b, ratio);
    drawTriad(b, ratio);
  }
  function redraw() {
    if (!asked) {
      asked = true;
      requestAnimationFrame(draw);
    }
  }

  function cameraAt(event) {
    if (!byId("show-cameras").checked) return -1;
    const b = basis(),
      ratio = canvas.width / canvas.clientWidth;
    let best = -1,
      nearest = 16;
    cameras.forEach((camera, k) => {
      const v = toView(b, camera.center);
      if (v[2] <= 0) return;
      const [x, y] = toPixel(v),
        away = Math.hypot(x / ratio - event.offsetX, y / ratio - event.offsetY);
      if (away < nearest) {
        nearest = away;
        best = k;
      }
    });
    return best;
  }

  function lookFrom(camera) {
    const axis = [0, 1, 2].map((a) => [0, 3, 6, 9].reduce((sum, q) => sum + camera.corners[q + a], 0));
    const f = axis.map((v) => v / Math.hypot(...axis));
    const depthOfScene = f.reduce((sum, v, k) => sum + v * (data.focus[k] - camera.center[k]), 0);
    const reach = Math.max(depthOfScene, 0.3 * data.radius),
      back = 2.2 * data.size;
    flyTo({
      ...start(),
      focus: camera.center.map((v, k) => v + reach * f[k]),
      yaw: Math.atan2(f[1], f[0]),
      pitch: Math.asin(Math.max(-1, Math.min(1, f[2]))),
      dist: reach + back,
    });
  }

  byId("reset-view").addEventListener("click", () => flyTo(start()));
  byId("view-above").addEventListener("click", () =>
    flyTo({ ...start(), yaw: Math.PI / 2, pitch: -1.57, dist: 2.7 * data.radius }),
  );
  byId("full-screen").addEventListener("click", () => fullScreen(canvas.parentElement));
  for (const id of ["point-size", "frustum-size", "show-cameras"]) byId(id).addEventListener("input", redraw);
  for (const box of curveBoxes) box.addEventListener("input", redraw);
  new ResizeObserver(redraw).observe(canvas);
  darkScheme.addEventListener("change", redraw);
  draw();
}
if (byId("space")) spaceView(byId("space"), readJson("model"));
