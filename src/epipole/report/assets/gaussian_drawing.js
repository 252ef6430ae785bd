/* Gaussians in WebGL2: each is the ellipse of its projection (Zwicker et al., EWA volume splatting, 2001), drawn as a
   parallelogram around it, from the farthest to the nearest. The equations are those of epipole.fields. */
/* global glProgram, EYE_GLSL, setEye */
/* exported gaussianDrawing, gaussianSorter */
"use strict";
const TEXTURE_WIDTH = 2048; // texels: two a Gaussian, one for its harmonics, one for its place in the order
const ORDER_UNIT = 2; // of the texture that setOrder writes to
const TOGETHER = 512; // Gaussians of an instance: graphics cards, and software more so, are slow with small ones

const VERTEX_SHADER = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D rows, harmonics, order;
uniform int shown;
${EYE_GLSL}
uniform vec2 scaleRange, colorRange, harmonicRange;
uniform bool hasHarmonics;
out vec2 away;
flat out float reach2, opacity;
flat out vec3 color;

vec3 triple(uint word) {
  return vec3(uvec3(word, word >> 10, word >> 20) & 1023u) / 1023.0;
}
void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // nowhere
  int rank = gl_InstanceID * ${TOGETHER} + (gl_VertexID >> 2);
  if (rank >= shown) return;
  int gaussian = int(texelFetch(order, ivec2(rank % ${TEXTURE_WIDTH}, rank / ${TEXTURE_WIDTH}), 0).r);
  int at = 2 * gaussian;
  ivec2 place = ivec2(at % ${TEXTURE_WIDTH}, at / ${TEXTURE_WIDTH});
  uvec4 first = texelFetch(rows, place, 0), second = texelFetch(rows, place + ivec2(1, 0), 0);
  vec3 mean = uintBitsToFloat(first.xyz), ray = mean - center, p = camFromWorld * ray;
  opacity = float(second.w >> 16) / 65535.0;
  if (!(p.z > near && opacity > 1.0 / 255.0) || isCut(mean)) return;

  vec4 q = normalize(vec4(unpackSnorm2x16(second.x), unpackSnorm2x16(second.y))); // w, x, y, z
  vec3 scale = exp(scaleRange.x + scaleRange.y * vec3(unpackUnorm2x16(second.z), unpackUnorm2x16(second.w).x));
  mat3 axes = mat3(
    scale.x * vec3(1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w), 2.0 * (q.y * q.w - q.x * q.z)),
    scale.y * vec3(2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w + q.x * q.y)),
    scale.z * vec3(2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
  );
  mat3 inCam = camFromWorld * axes;
  vec2 limit = 0.65 * size / focal;
  vec2 uv = clamp(p.xy / p.z, -limit, limit);
  vec3 depths = vec3(inCam[0].z, inCam[1].z, inCam[2].z);
  vec3 across = focal / p.z * (vec3(inCam[0].x, inCam[1].x, inCam[2].x) - uv.x * depths);
  vec3 down = focal / p.z * (vec3(inCam[0].y, inCam[1].y, inCam[2].y) - uv.y * depths);
  // V = L L^T; its determinant from a cross product, which loses no digits of thin ellipses.
  float vxx = dot(across, across), vyy = dot(down, down), vxy = dot(across, down);
  vec3 both = cross(across, down);
  float det = dot(both, both) + 0.3 * (vxx + vyy) + 0.09;
  vxx += 0.3;
  vyy += 0.3;
  reach2 = 2.0 * log(255.0 * opacity);
  vec2 pixel = focal * p.xy / p.z, half_ = sqrt(reach2 * vec2(vxx, vyy));
  if (!(det < 1e30) || any(greaterThan(abs(pixel) - half_, 0.5 * size))) return;
  float l11 = sqrt(vxx);
  away = sqrt(reach2) * vec2(float(gl_VertexID & 1) * 2.0 - 1.0, float(gl_VertexID & 2) - 1.0);
  vec2 offset = vec2(l11 * away.x, vxy / l11 * away.x + sqrt(det) / l11 * away.y);
  gl_Position = vec4((pixel + offset) * vec2(2.0, -2.0) / size, 1.0 - 2.0 * near / p.z, 1.0); // as of clipOf

  color = colorRange.x + colorRange.y * triple(first.w);
  if (hasHarmonics) {
    ivec2 own = ivec2(gaussian % ${TEXTURE_WIDTH}, gaussian / ${TEXTURE_WIDTH});
    uvec4 words = texelFetch(harmonics, own, 0);
    vec3 d = 0.4886025119029199 * normalize(ray);
    mat3 sh = mat3(triple(words.x), triple(words.y), triple(words.z));
    color += harmonicRange.x * (d.z - d.y - d.x) + harmonicRange.y * (sh * vec3(-d.y, d.z, -d.x));
  }
  color = max(color, 0.0);
}`;

const FRAGMENT_SHADER = `#version 300 es
precision highp float;
in vec2 away;
flat in float reach2, opacity;
flat in vec3 color;
out vec4 drawn;
void main() {
  float d2 = dot(away, away);
  if (d2 > reach2) discard;
  float alpha = min(opacity * exp(-0.5 * d2), 0.99);
  drawn = vec4(color * alpha, alpha);
}`;

/* `put` uploads Gaussians: `words` holds 8 numbers for each, `harmonics` 3 or is null. */
function gaussianDrawing(gl) {
  const made = glProgram(gl, VERTEX_SHADER, FRAGMENT_SHADER);
  gl.useProgram(made.program);
  const at = made.at;
  ["rows", "harmonics", "order"].forEach((name, unitNumber) => {
    gl.activeTexture(gl.TEXTURE0 + unitNumber);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
      gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    gl.uniform1i(at(name), unitNumber);
  });
  function heightOf(texels) {
    const height = Math.max(1, Math.ceil(texels / TEXTURE_WIDTH));
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE))
      throw new Error("there are more Gaussians than this device can hold");
    return height;
  }
  /* Words in texels of four, of which the first `used` are told. */
  function putWords(unitNumber, numbers, used) {
    const texels = numbers.length / used,
      height = heightOf(texels),
      padded = new Uint32Array(4 * TEXTURE_WIDTH * height);
    if (used === 4) padded.set(numbers);
    else for (let k = 0; k < texels; k++) padded.set(numbers.subarray(used * k, used * k + used), 4 * k);
    const form = [gl.RGBA_INTEGER, gl.UNSIGNED_INT, padded];
    gl.activeTexture(gl.TEXTURE0 + unitNumber);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, TEXTURE_WIDTH, height, 0, ...form);
  }

  const corners = new Uint16Array(6 * TOGETHER);
  for (let k = 0; k < TOGETHER; k++)
    corners.set(
      [0, 1, 2, 2, 1, 3].map((corner) => 4 * k + corner),
      6 * k,
    );
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
  gl.bindVertexArray(null);

  let shown = 0;
  return {
    put({ numbers, words, harmonics }) {
      gl.useProgram(made.program);
      putWords(0, words, 4);
      putWords(1, harmonics || new Uint32Array(0), 3);
      gl.uniform1i(at("hasHarmonics"), harmonics ? 1 : 0);
      for (const name of ["scaleRange", "colorRange", "harmonicRange"])
        gl.uniform2fv(at(name), numbers[name]);
      const form = [heightOf(numbers.count), 0, gl.RED_INTEGER, gl.UNSIGNED_INT, null];
      gl.activeTexture(gl.TEXTURE0 + ORDER_UNIT);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32UI, TEXTURE_WIDTH, ...form);
      shown = 0;
    },
    /* The first `count` rows, the farthest first, are drawn; there is room for whole lines of the texture. */
    setOrder(rows, count) {
      const form = [gl.RED_INTEGER, gl.UNSIGNED_INT, rows];
      shown = count;
      gl.activeTexture(gl.TEXTURE0 + ORDER_UNIT);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, Math.ceil(count / TEXTURE_WIDTH), ...form);
    },
    /* Over what is there already; what lies before a Gaussian's middle hides it. */
    draw(eye) {
      setEye(gl, made, eye);
      gl.uniform1i(at("shown"), shown);
      gl.enable(gl.BLEND);
      gl.depthMask(false);
      gl.bindVertexArray(array);
      const instances = Math.ceil(shown / TOGETHER);
      gl.drawElementsInstanced(gl.TRIANGLES, 6 * TOGETHER, gl.UNSIGNED_SHORT, 0, instances);
      gl.bindVertexArray(null);
      gl.depthMask(true);
      gl.disable(gl.BLEND);
    },
  };
}

/* Gaussians from the farthest to the nearest: a counting sort by the bits of the depth, which grow with it and are as
   fine near as far. Behind the eye's plane there are none. It stands alone: a worker is made from its text. */
function sortByDepth(places, f, o, near, order) {
  const count = places.length / 3,
    keys = new Uint32Array(count),
    depths = new Float32Array(keys.buffer),
    buckets = new Uint32Array(65537);
  let least = 0xffffffff,
    most = 0,
    kept = 0;
  for (let k = 0, q = 0; k < count; k++, q += 3) {
    const depth = f[0] * (places[q] - o[0]) + f[1] * (places[q + 1] - o[1]) + f[2] * (places[q + 2] - o[2]);
    depths[k] = depth > near ? depth : 0;
    const bits = keys[k];
    if (!bits) continue;
    if (bits < least) least = bits;
    if (bits > most) most = bits;
    kept++;
  }
  const step = 65535 / Math.max(most - least, 1);
  for (let k = 0; k < count; k++) if (keys[k]) buckets[1 + ((step * (most - keys[k])) | 0)]++;
  for (let k = 0; k < 65536; k++) buckets[k + 1] += buckets[k];
  for (let k = 0; k < count; k++) if (keys[k]) order[buckets[(step * (most - keys[k])) | 0]++] = k;
  return kept;
}

/* Sorts beside the page where the browser lets it, else on it; `ready(order, count, milliseconds, places)` gets whole
   lines of a texture, of which the first `count` rows are told, and the places that they are the order of. */
function gaussianSorter(ready) {
  let places = null,
    order = null,
    worker = null,
    asked = null;
  const newOrder = () => new Uint32Array(TEXTURE_WIDTH * Math.ceil(places.length / 3 / TEXTURE_WIDTH));
  function sortHere({ f, o, near }) {
    const begin = performance.now(),
      kept = sortByDepth(places, f, o, near, order);
    ready(order, kept, performance.now() - begin, places);
  }
  const source = `"use strict";
${sortByDepth}
let places;
onmessage = ({ data }) => {
  if (data.places) return void (places = data.places);
  const begin = performance.now(), kept = sortByDepth(places, data.f, data.o, data.near, data.order);
  postMessage({ order: data.order, kept, spent: performance.now() - begin }, [data.order.buffer]);
};`;
  try {
    const address = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
    worker = new Worker(address);
    worker.onmessage = ({ data }) => {
      order = data.order;
      asked = null;
      ready(order, data.kept, data.spent, places);
    };
    worker.onerror = () => {
      const view = asked;
      worker = asked = null;
      order = newOrder();
      if (view) sortHere(view);
    };
  } catch {
    worker = null;
  }
  return {
    isBusy: () => asked !== null,
    /* The places to sort from now on; not while it is busy. */
    hold(held) {
      places = held;
      order = newOrder();
      if (worker) worker.postMessage({ places });
    },
    sort(view) {
      if (!worker) return sortHere(view);
      asked = view;
      worker.postMessage({ ...view, order }, [order.buffer]);
    },
  };
}
