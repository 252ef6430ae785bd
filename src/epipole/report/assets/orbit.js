/* The eye of a 3D view, turned around a place by drags, fingers, wheel and keys. */
/* exported orbitEye, eyeAt, frameOf, cross, dot, unit, fullScreen */
"use strict";
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const unit = (a) => a.map((v) => v / Math.hypot(...a));

const WORLD = [
  [1, 0, 0],
  [0, 1, 0],
  [0, 0, 1],
];

/* Three axes, the third of them in the given direction. */
function frameOf(up) {
  const z = unit(up),
    least = z.map(Math.abs).indexOf(Math.min(...z.map(Math.abs))),
    x = unit(cross(WORLD[least], z));
  return [x, cross(z, x), z];
}
function axesAt(frame, yaw, pitch) {
  const cy = Math.cos(yaw),
    sy = Math.sin(yaw),
    cp = Math.cos(pitch),
    sp = Math.sin(pitch);
  const inWorld = (v) => [0, 1, 2].map((k) => v[0] * frame[0][k] + v[1] * frame[1][k] + v[2] * frame[2][k]);
  const f = inWorld([cp * cy, cp * sy, sp]),
    r = inWorld([sy, -cy, 0]);
  return { f, r, d: cross(f, r) };
}
/* The eye at o that looks along f, with r to its right. */
function eyeAt(frame, { o, f, r, dist, spread }) {
  const yaw = Math.atan2(dot(f, frame[1]), dot(f, frame[0])),
    pitch = Math.asin(Math.max(-1, Math.min(1, dot(f, frame[2])))),
    level = axesAt(frame, yaw, pitch),
    roll = Math.atan2(dot(r, level.d), dot(r, level.r));
  return { focus: o.map((v, k) => v + dist * f[k]), yaw, pitch, roll, dist, spread };
}

/* An eye is { focus, yaw, pitch, roll, dist, spread }: spread is half the shorter side at distance 1. `frame` holds
   three axes of the world, the third of them up. Of `basis`, r is right, d down, f ahead and o where the eye is. */
function orbitEye(
  canvas,
  { start, radiusNow, redraw, frame = WORLD, hover, click, leave, keys, wheelAlways, reset },
) {
  const fingers = new Map();
  let eye = start(),
    moved = 0,
    span = 0,
    flight = 0,
    isFlying = false,
    active = false;

  function basis() {
    const { f, r, d } = axesAt(frame, eye.yaw, eye.pitch),
      c = Math.cos(eye.roll),
      s = Math.sin(eye.roll);
    return {
      f,
      r: r.map((v, k) => c * v + s * d[k]),
      d: d.map((v, k) => c * v - s * r[k]),
      o: eye.focus.map((v, k) => v - eye.dist * f[k]),
    };
  }
  const focal = () => (0.5 * Math.min(canvas.width, canvas.height)) / eye.spread;

  function jumpTo(goal) {
    flight++;
    isFlying = false;
    eye = goal;
    redraw();
  }
  function flyTo(goal, { ms = 600, then = null } = {}) {
    const from = eye,
      begin = performance.now(),
      mine = ++flight;
    isFlying = true;
    const length = matchMedia("(prefers-reduced-motion: reduce)").matches ? 1 : ms;
    const nearest = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));
    const turn = nearest(goal.yaw - from.yaw),
      lean = nearest(goal.roll - from.roll);
    (function step(now) {
      if (flight !== mine) return; // a hand, or another flight, has taken over
      const t = Math.min(1, Math.max(0, (now - begin) / length)),
        s = t * t * (3 - 2 * t);
      eye = {
        focus: from.focus.map((v, k) => v + s * (goal.focus[k] - v)),
        yaw: from.yaw + s * turn,
        pitch: from.pitch + s * (goal.pitch - from.pitch),
        roll: from.roll + s * lean,
        dist: from.dist + s * (goal.dist - from.dist),
        spread: from.spread + s * (goal.spread - from.spread),
      };
      isFlying = t < 1;
      redraw();
      if (isFlying) requestAnimationFrame(step);
      else if (then) then();
    })(begin);
  }

  function turnBy(dx, dy) {
    eye.yaw -= 0.006 * dx;
    eye.pitch = Math.max(-1.57, Math.min(1.57, eye.pitch - 0.006 * dy));
    eye.roll *= Math.exp(-0.006 * Math.hypot(dx, dy)); // what a camera leaned is lost while one turns
  }
  function panBy(dx, dy) {
    const b = basis(),
      scale = eye.dist / ((focal() * canvas.clientWidth) / canvas.width);
    eye.focus = eye.focus.map((v, k) => v - scale * (dx * b.r[k] + dy * b.d[k]));
  }
  function zoomBy(factor) {
    eye.dist = Math.max(0.005 * radiusNow(), Math.min(60 * radiusNow(), eye.dist * factor));
  }
  function byHand(change) {
    flight++;
    isFlying = false;
    eye = { ...eye };
    change();
    redraw();
  }

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    moved = 0;
    span = 0;
    active = true;
    flight++; // a hand takes over
    isFlying = false;
    if (leave) leave(event);
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last) return hover && hover(event);
    const dx = event.clientX - last[0],
      dy = event.clientY - last[1];
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    moved += Math.abs(dx) + Math.abs(dy);
    byHand(() => {
      if (fingers.size === 2) {
        const [p, q] = [...fingers.values()],
          now = Math.hypot(p[0] - q[0], p[1] - q[1]);
        if (span > 0) zoomBy(span / Math.max(now, 1));
        span = now;
        panBy(dx / 2, dy / 2);
      } else if (event.buttons & 6 || event.shiftKey) panBy(dx, dy);
      else turnBy(dx, dy);
    });
  });
  for (const kind of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(kind, (event) => {
      fingers.delete(event.pointerId);
      span = 0;
      if (kind === "pointerup" && moved < 4 && click) click(event);
    });
  }
  canvas.addEventListener("pointerleave", (event) => {
    active = false;
    if (leave) leave(event);
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener(
    "wheel",
    (event) => {
      if (!wheelAlways && !active && !event.ctrlKey) return;
      event.preventDefault();
      byHand(() => zoomBy(Math.exp(0.0012 * event.deltaY * (event.deltaMode ? 16 : 1))));
    },
    { passive: false },
  );
  (keys || canvas).addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const act = {
      ArrowLeft: () => turnBy(20, 0),
      ArrowRight: () => turnBy(-20, 0),
      ArrowUp: () => turnBy(0, 20),
      ArrowDown: () => turnBy(0, -20),
      "+": () => zoomBy(0.85),
      "-": () => zoomBy(1.18),
    }[event.key];
    if (!act && event.key.toLowerCase() !== "r") return;
    event.preventDefault();
    if (act) byHand(act);
    else if (reset) reset();
    else flyTo(start());
  });
  return { basis, focal, flyTo, jumpTo, eye: () => eye, isFlying: () => isFlying };
}

function fullScreen(stage) {
  return document.fullscreenElement ? document.exitFullscreen() : stage.requestFullscreen();
}
