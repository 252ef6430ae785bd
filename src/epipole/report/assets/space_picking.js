/* What lies under a pixel of a 3D view, and how far apart two such places are. */
/* global dot */
/* exported pickPoint, pickTriangle, pickGaussian, distanceBetween */
"use strict";
/* A pixel's ray in the eye's frame is (x, y, 1); `reach` is the tolerance at depth 1. The nearest point wins, a little
   less so the farther it is from the ray. Points are four floats each, of which three are the place. Gives
   { place, depth, row } or null. */
function pickPoint(rows, count, { r, d, f, o }, x, y, reach, near, passes) {
  let best = Infinity,
    found = null;
  for (let k = 0, q = 0; k < count; k++, q += 4) {
    const ax = rows[q] - o[0],
      ay = rows[q + 1] - o[1],
      az = rows[q + 2] - o[2],
      z = f[0] * ax + f[1] * ay + f[2] * az;
    if (!(z > near) || z > best) continue;
    const u = (r[0] * ax + r[1] * ay + r[2] * az) / z - x,
      v = (d[0] * ax + d[1] * ay + d[2] * az) / z - y,
      away = (u * u + v * v) / (reach * reach);
    if (away > 1 || z * (1 + 0.2 * away) >= best || !passes(k)) continue;
    best = z * (1 + 0.2 * away);
    found = { row: k, depth: z, place: Array.from(rows.subarray(q, q + 3)) };
  }
  return found;
}

/* The first triangle along the ray from o (Moeller and Trumbore, 1997); both sides count. */
function pickTriangle(vertices, faces, o, ray, passes) {
  let best = Infinity;
  const at = (k, a) => vertices[3 * k + a];
  for (let q = 0; q < faces.length; q += 3) {
    const [a, b, c] = [faces[q], faces[q + 1], faces[q + 2]];
    const e1x = at(b, 0) - at(a, 0),
      e1y = at(b, 1) - at(a, 1),
      e1z = at(b, 2) - at(a, 2);
    const e2x = at(c, 0) - at(a, 0),
      e2y = at(c, 1) - at(a, 1),
      e2z = at(c, 2) - at(a, 2);
    const px = ray[1] * e2z - ray[2] * e2y,
      py = ray[2] * e2x - ray[0] * e2z,
      pz = ray[0] * e2y - ray[1] * e2x;
    const det = e1x * px + e1y * py + e1z * pz;
    if (Math.abs(det) < 1e-30) continue;
    const sx = o[0] - at(a, 0),
      sy = o[1] - at(a, 1),
      sz = o[2] - at(a, 2);
    const u = (sx * px + sy * py + sz * pz) / det;
    if (u < 0 || u > 1) continue;
    const qx = sy * e1z - sz * e1y,
      qy = sz * e1x - sx * e1z,
      qz = sx * e1y - sy * e1x;
    const v = (ray[0] * qx + ray[1] * qy + ray[2] * qz) / det;
    if (v < 0 || u + v > 1) continue;
    const t = (e2x * qx + e2y * qy + e2z * qz) / det;
    if (t > 0 && t < best && passes(o.map((value, k) => value + t * ray[k]))) best = t;
  }
  return best < Infinity ? { place: o.map((value, k) => value + best * ray[k]), depth: best } : null;
}

/* The depth at which half of the light from a pixel is held up by Gaussians, taken to be round. */
function pickGaussian(words, places, scaleRange, { r, d, f, o }, x, y, focal, near, passes) {
  const hits = [];
  for (let k = 0, q = 0; q < places.length; k++, q += 3) {
    const ray = [places[q] - o[0], places[q + 1] - o[1], places[q + 2] - o[2]],
      z = dot(f, ray);
    if (!(z > near)) continue;
    const third = words[8 * k + 6],
      sum = (third & 65535) + (third >>> 16) + (words[8 * k + 7] & 65535),
      size = Math.exp(scaleRange[0] + (scaleRange[1] * sum) / (3 * 65535)); // of the mean logarithm
    const off = Math.hypot(dot(r, ray) / z - x, dot(d, ray) / z - y),
      ratio2 = off ** 2 / ((3 / focal) ** 2 + (size / z) ** 2);
    if (ratio2 < 9 && passes(places.subarray(q, q + 3)))
      hits.push([z, ((words[8 * k + 7] >>> 16) / 65535) * Math.exp(-0.5 * ratio2)]);
  }
  let through = 1;
  for (const [z, held] of hits.sort((a, b) => a[0] - b[0])) {
    through *= 1 - held;
    if (through < 0.5) return { depth: z, place: o.map((v, k) => v + z * (f[k] + x * r[k] + y * d[k])) };
  }
  return null;
}

/* Of two places with covariances (xx, xy, xz, yy, yz, zz; null: not known) that err independently: the deviation of
   their distance to first order, sqrt(u' (C1 + C2) u) for the direction u between them. */
function distanceBetween(a, b) {
  const between = b.place.map((v, k) => v - a.place[k]),
    length = Math.hypot(...between);
  if (!a.covariance || !b.covariance) return { length, sigma: null };
  const [x, y, z] = length > 0 ? between.map((v) => v / length) : [0, 0, 0];
  const along = (c) =>
    c[0] * x * x + c[3] * y * y + c[5] * z * z + 2 * (c[1] * x * y + c[2] * x * z + c[4] * y * z);
  const variance = along(a.covariance) + along(b.covariance);
  return { length, sigma: variance < 1e30 ? Math.sqrt(Math.max(variance, 0)) : Infinity };
}
