/* The house that cameras look at, and cameras from above. */
/* exported SCENE, HERE, drawHouse, drawCamera, motionOf */
const SCENE = JSON.parse(byId("scene").textContent);
const HERE = {
  R: [
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
  ],
  t: [0, 0, 0],
};

/* The second camera is moved by (tx, ty, tz) and turned: cam2_from_cam1 = (R, -R c). */
function motionOf({ tx = 0, ty = 0, tz = 0, yaw = 0, pitch = 0, roll = 0 }) {
  const R = transposed(rotationOf([degrees(-pitch), degrees(yaw), degrees(roll)]));
  return { R, t: scaled(applied(R, [tx, ty, tz]), -1) };
}

/* In a picture. */
function drawHouse(inside, corners, motion) {
  const seen = corners.map((corner) => moved(motion, corner));
  for (const [a, b] of SCENE.edges) {
    if (seen[a][2] < 0.02 || seen[b][2] < 0.02) continue;
    const [one, other] = [project(seen[a]), project(seen[b])];
    add(inside, "line", { class: "house", x1: one[0], y1: one[1], x2: other[0], y2: other[1] });
  }
}

/* A camera from above: where it is, and which way it looks; `size` is its length in the scene. */
function drawCamera(svg, toPlace, { R, t }, kind, size = 0.8) {
  const back = inverseMotion({ R, t }),
    at = toPlace(back.t);
  const ends = [-0.56, 0.56].map((x) => toPlace(moved(back, [size * x, 0, size])));
  add(svg, "path", { class: "camera " + kind, d: `M${at} L${ends[0]} L${ends[1]} Z` });
}
