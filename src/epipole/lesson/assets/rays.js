/* Two rays, and the angle of a turn. */
/* exported triangulated, angleOf */

/* As `epipole.geometry.triangulation.triangulate_two_view`: the middle of the shortest way between two rays, and where it is on each. */
function triangulated({ R, t }, ray1, ray2) {
  const d1 = applied(R, unit(ray1)),
    d2 = unit(ray2),
    normal = cross(d1, d2),
    sine = dot(normal, normal);
  const along1 = dot(cross(d2, t), normal) / sine,
    along2 = dot(cross(d1, t), normal) / sine;
  const middle = scaled(plus(plus(scaled(d1, along1), t), scaled(d2, along2)), 0.5);
  return { point: moved(inverseMotion({ R, t }), middle), along1, along2 };
}

const angleOf = (R) => {
  const axis = [R[2][1] - R[1][2], R[0][2] - R[2][0], R[1][0] - R[0][1]]; // sine and cosine: either alone is unsure somewhere
  return (Math.atan2(norm(axis), R[0][0] + R[1][1] + R[2][2] - 1) * 180) / Math.PI;
};
