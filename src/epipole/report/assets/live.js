/* The live view of a job. Server-sent events announce its state; the page fetches what is new, and draws it for at most a
   twentieth of the time: where there is no graphics card, it takes the job's processor. */
/* global byId, space, curvePieces, pictureDrawing */
"use strict";
const [REST_TIMES_LIVE, QUICK_DRAW_MS, LOST_AFTER_MS] = [19, 40, 5000];
const [LEAST_PAUSE_MS, MOST_PAUSE_MS] = [400, 4000];
const SLOW_DRAW_MS = 150; // then half of the resolution is drawn until the job ends

async function liveView(canvas, scene) {
  const { data, view, drawn } = scene,
    live = data.live,
    nowCurve = drawn.curves.length - 1,
    shown = { scene: 0, image: 0 },
    source = new EventSource("live/events");
  let news = null,
    taken = null,
    wake = () => {},
    endPause = () => {},
    lost = 0,
    hasPoints = false;

  function say(state, words, fraction) {
    byId("live-state").textContent = state;
    byId("live-words").textContent = words;
    byId("live-progress").hidden = fraction === null;
    byId("live-progress").value = fraction || 0;
  }
  source.addEventListener("message", (event) => {
    clearTimeout(lost);
    lost = 0;
    news = JSON.parse(event.data);
    if (news.run !== live.run) return location.reload(); // another job is at this address now
    document.documentElement.dataset.live = news.ended ? "ended" : "running";
    if (news.ended) source.close();
    wake();
  });
  source.addEventListener("error", () => {
    lost ||= setTimeout(() => {
      document.documentElement.dataset.live = "lost";
      say("No connection to the job.", "This is the last state that it sent.", null);
    }, LOST_AFTER_MS);
  });
  document.addEventListener("visibilitychange", () => wake());

  const follow = byId("follow-camera");
  const setFollow = (is) => follow && follow.setAttribute("aria-pressed", String(is));
  const isFollowing = () => follow && follow.getAttribute("aria-pressed") === "true" && scene.chosen() < 0;
  if (follow) follow.addEventListener("click", () => setFollow(!isFollowing()));
  canvas.addEventListener("dblclick", () => setFollow(false));

  /* One message: the length of the numbers, the numbers as JSON, and the blocks one after another. */
  async function fetchScene() {
    const answer = await fetch("live/scene");
    if (!answer.ok) return;
    const bytes = await answer.arrayBuffer(),
      size = new DataView(bytes).getUint32(0, true),
      fresh = JSON.parse(new TextDecoder().decode(new Uint8Array(bytes, 4, size))),
      blocks = {};
    let at = 4 + size;
    fresh.blocks.forEach((name, k) => {
      blocks[name] = bytes.slice(at, at + fresh.lengths[k]);
      at += fresh.lengths[k];
    });
    scene.update(fresh, blocks);
  }
  async function showImage(number) {
    const image = byId("live-image");
    image.src = `live/image?${number}`;
    await image.decode();
    image.parentElement.hidden = false;
  }
  /* What the job renders from here, as a backdrop that stays in its place while the eye moves on. */
  async function showView() {
    const { o, r, d, f } = view.basis(),
      dist = view.eye().dist,
      tangent = (0.5 * canvas.height) / view.focal(),
      aspect = Math.max(0.25, Math.min(4, canvas.width / canvas.height));
    const image = new Image(),
      position = o.map((v, k) => v + data.origin[k]);
    image.src = `live/view?${[...position, ...f, ...d, tangent, aspect].map((v) => v.toPrecision(12)).join(",")}`;
    await image.decode();
    const corner = (x, y) => f.map((v, k) => dist * (v + tangent * (aspect * x * r[k] + y * d[k])));
    drawn.backdrop ||= { drawing: pictureDrawing(scene.gl), scale: 1, opacity: 1 };
    drawn.backdrop.drawing.put(image);
    const corners = [...corner(-1, -1), ...corner(1, -1), ...corner(1, 1), ...corner(-1, 1)];
    Object.assign(drawn.backdrop, { place: o, corners });
    scene.redraw();
  }
  function placeCamera() {
    const relative = (values) => values.map((v, k) => v - data.origin[k % 3]),
      color = data.curves[nowCurve].rgb.map((v) => v / 255);
    drawn.curves[nowCurve].put(curvePieces(new Float32Array(relative(news.camera || [])), color));
    scene.redraw();
    if (!hasPoints && data.points[0].count) {
      hasPoints = true; // before that, the scale is unknown
      view.jumpTo(scene.start());
    }
    if (!news.position || !isFollowing() || view.isFlying()) return;
    view.jumpTo({ ...view.eye(), focus: relative(news.position) });
  }
  async function show() {
    say(news.ended || news.state, news.words || "", news.ended ? null : (news.fraction ?? null));
    const { scene: newest = 0, image = 0 } = news.parts;
    if (image > shown.image) await showImage((shown.image = image));
    if (newest > shown.scene) {
      shown.scene = newest;
      await fetchScene();
    }
    if (live.has_views) await showView();
    if (live.has_camera) placeCamera();
  }

  const untilNews = () =>
    new Promise((ready) => {
      wake = () => {
        if (news && news.ended) endPause();
        if (news !== taken && (news.ended || !document.hidden)) ready();
      };
      wake();
    });
  if (!document.hidden) await scene.settled(); // the first drawing, which takes longer, does not count
  for (;;) {
    await untilNews();
    taken = news;
    await show().catch(() => {}); // the server is gone, or has no time: the next state may come
    const begin = performance.now();
    if (taken.ended) break;
    if (!document.hidden) await scene.settled();
    const spent = performance.now() - begin - QUICK_DRAW_MS, // of which a graphics card waits two frames
      pause = Math.min(MOST_PAUSE_MS, Math.max(LEAST_PAUSE_MS, REST_TIMES_LIVE * spent));
    if (spent > SLOW_DRAW_MS) scene.look.mostRatio = 0.5;
    await new Promise((ready) => {
      endPause = ready;
      setTimeout(ready, pause);
    });
  }
  scene.look.mostRatio = 2;
  scene.redraw();
  await fetch("live/final").catch(() => {});
  document.documentElement.dataset.live = "final";
}

space.then((scene) => scene && liveView(byId("space"), scene));
