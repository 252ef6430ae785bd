/* Points, lines and triangles in WebGL2. */
/* global glProgram, EYE_GLSL, setEye */
/* exported pointDrawing, lineDrawing, meshDrawing, pictureDrawing, frustumPieces, curvePieces */
"use strict";
const POINT_VERTEX = `#version 300 es
precision highp float;
${EYE_GLSL}
uniform float pointSize, mostSize;
uniform vec4 limits; // of the two measures: least and most
uniform int colorBy; // 0: their own; 1, 2: a measure
uniform vec3 ramp[16];
layout(location = 0) in vec3 place;
layout(location = 1) in vec3 rgb;
layout(location = 2) in vec2 values; // 1: not known
out vec3 color;
void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // nowhere
  gl_PointSize = 1.0;
  vec3 p = camFromWorld * (place - center);
  bvec2 known = lessThan(values, vec2(1.0));
  bvec2 out_ = bvec2(known.x && (values.x < limits.x || values.x > limits.y), known.y && (values.y < limits.z || values.y > limits.w));
  if (p.z < near || isCut(place) || any(out_)) return;
  gl_Position = clipOf(p);
  gl_PointSize = clamp(pointSize / p.z, 1.0, mostSize);
  color = rgb;
  if (colorBy > 0) {
    float t = colorBy == 1 ? values.x : values.y, at = 15.0 * clamp(t, 0.0, 1.0);
    int stop = min(int(at), 14);
    color = t < 1.0 ? mix(ramp[stop], ramp[stop + 1], at - float(stop)) : vec3(0.35);
  }
}`;
const POINT_FRAGMENT = `#version 300 es
precision mediump float;
in vec3 color;
out vec4 drawn;
void main() { drawn = vec4(color, 1.0); }`;

/* One layer of points. `put` uploads them, each three floats and three bytes of color in 16 bytes, with their measures
   or null; `draw(eye, look)` draws `look.count` of them from `look.first` on. */
function pointDrawing(gl, ramp) {
  const made = glProgram(gl, POINT_VERTEX, POINT_FRAGMENT),
    array = gl.createVertexArray(),
    [rowBuffer, valueBuffer] = [gl.createBuffer(), gl.createBuffer()];
  const fill = (buffer, data) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
  };
  return {
    put(rows, values) {
      gl.bindVertexArray(array);
      fill(rowBuffer, rows);
      gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 16, 0);
      gl.vertexAttribPointer(1, 3, gl.UNSIGNED_BYTE, true, 16, 12);
      if (values) {
        fill(valueBuffer, values);
        gl.vertexAttribPointer(2, 2, gl.UNSIGNED_SHORT, true, 0, 0);
      }
      for (const location of values ? [0, 1, 2] : [0, 1]) gl.enableVertexAttribArray(location);
      gl.bindVertexArray(null);
    },
    draw(eye, { first, count, sizePx, mostPx, limits, colorBy }) {
      setEye(gl, made, eye);
      gl.uniform1f(made.at("pointSize"), sizePx);
      gl.uniform1f(made.at("mostSize"), mostPx);
      gl.uniform4fv(made.at("limits"), limits);
      gl.uniform1i(made.at("colorBy"), colorBy);
      gl.uniform3fv(made.at("ramp"), ramp);
      gl.bindVertexArray(array);
      gl.vertexAttrib2f(2, 1, 1);
      gl.drawArrays(gl.POINTS, first, count);
      gl.bindVertexArray(null);
    },
  };
}

/* A piece of a line is two ends, each a place and an offset from it that grows with `scale` (0 for curves). It is drawn
   as a rectangle of `width` pixels; its parts behind the eye are cut off. */
const LINE_VERTEX = `#version 300 es
precision highp float;
${EYE_GLSL}
uniform float scale, width;
uniform int chosen, hovered;
layout(location = 0) in vec3 place1;
layout(location = 1) in vec3 offset1;
layout(location = 2) in vec3 place2;
layout(location = 3) in vec3 offset2;
layout(location = 4) in vec3 rgb;
layout(location = 5) in float owner;
out vec3 color, at;
void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  vec3 w1 = place1 + scale * offset1, w2 = place2 + scale * offset2;
  vec3 a = camFromWorld * (w1 - center), b = camFromWorld * (w2 - center);
  if (a.z < near && b.z < near) return;
  float cut = 1.01 * near;
  if (a.z < cut) { float t = (cut - a.z) / (b.z - a.z); a = mix(a, b, t); w1 = mix(w1, w2, t); }
  if (b.z < cut) { float t = (cut - b.z) / (a.z - b.z); b = mix(b, a, t); w2 = mix(w2, w1, t); }
  vec2 way = focal * (b.xy / b.z - a.xy / a.z);
  way = length(way) > 1e-6 ? normalize(way) : vec2(1.0, 0.0);
  bool isMarked = owner >= 0.0 && (int(owner) == chosen || int(owner) == hovered);
  float along = float(gl_VertexID & 1), aside = float(gl_VertexID & 2) - 1.0;
  float reach = 0.5 * width * (isMarked ? 2.0 : 1.0);
  vec3 p = along > 0.5 ? b : a;
  vec2 shift = reach * (vec2(-way.y, way.x) * aside + way * (2.0 * along - 1.0));
  gl_Position = clipOf(p);
  gl_Position.xy += shift * vec2(2.0, -2.0) / size * gl_Position.w;
  color = isMarked ? vec3(1.0, 0.83, 0.3) : rgb;
  at = along > 0.5 ? w2 : w1;
}`;
const LINE_FRAGMENT = `#version 300 es
precision highp float;
${EYE_GLSL}
in vec3 color, at;
out vec4 drawn;
void main() {
  if (isCut(at)) discard;
  drawn = vec4(color, 1.0);
}`;
const LINE_FLOATS = 16;

/* `put` uploads pieces of 16 numbers each: place, offset, place, offset, color (0 to 1), and whose it is (-1: nobody's). */
function lineDrawing(gl) {
  const made = glProgram(gl, LINE_VERTEX, LINE_FRAGMENT),
    array = gl.createVertexArray(),
    buffer = gl.createBuffer();
  let count = 0;
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  [3, 3, 3, 3, 3, 1].forEach((length, location) => {
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, length, gl.FLOAT, false, 4 * LINE_FLOATS, 12 * location);
    gl.vertexAttribDivisor(location, 1);
  });
  gl.bindVertexArray(null);
  return {
    put(pieces) {
      count = pieces.length / LINE_FLOATS;
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, pieces, gl.STATIC_DRAW);
    },
    draw(eye, { scale = 0, width, chosen = -1, hovered = -1 }) {
      if (!count) return;
      setEye(gl, made, eye);
      gl.uniform1f(made.at("scale"), scale);
      gl.uniform1f(made.at("width"), width);
      gl.uniform1i(made.at("chosen"), chosen);
      gl.uniform1i(made.at("hovered"), hovered);
      gl.bindVertexArray(array);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
      gl.bindVertexArray(null);
    },
  };
}

/* Eight edges a camera: from its center to the image's corners, and around the image. */
function frustumPieces(places, corners, rgb) {
  const count = places.length / 3,
    out = new Float32Array(8 * LINE_FLOATS * count);
  for (let k = 0, at = 0; k < count; k++) {
    const place = places.subarray(3 * k, 3 * k + 3),
      corner = (q) => corners.subarray(12 * k + 3 * q, 12 * k + 3 * q + 3);
    for (let q = 0; q < 8; q++, at += LINE_FLOATS) {
      out.set(place, at);
      out.set(place, at + 6);
      if (q >= 4) out.set(corner(q - 4), at + 3);
      out.set(corner(q < 4 ? q : (q - 3) % 4), at + 9);
      out.set([...rgb, k], at + 12);
    }
  }
  return out;
}
function curvePieces(ends, rgb) {
  const count = ends.length / 6,
    out = new Float32Array(LINE_FLOATS * count);
  for (let k = 0; k < count; k++) {
    out.set(ends.subarray(6 * k, 6 * k + 3), LINE_FLOATS * k);
    out.set(ends.subarray(6 * k + 3, 6 * k + 6), LINE_FLOATS * k + 6);
    out.set([...rgb, -1], LINE_FLOATS * k + 12);
  }
  return out;
}

/* Triangles, each as light as it faces the eye. */
const MESH_VERTEX = `#version 300 es
precision highp float;
${EYE_GLSL}
layout(location = 0) in vec3 place;
layout(location = 1) in vec4 rgba;
out vec3 color, at, seen;
void main() {
  seen = camFromWorld * (place - center);
  gl_Position = clipOf(seen);
  color = rgba.rgb;
  at = place;
}`;
const MESH_FRAGMENT = `#version 300 es
precision highp float;
${EYE_GLSL}
in vec3 color, at, seen;
out vec4 drawn;
void main() {
  if (isCut(at)) discard;
  vec3 normal = cross(dFdx(seen), dFdy(seen));
  float facing = abs(dot(normal, seen)) / max(length(normal) * length(seen), 1e-30);
  drawn = vec4(color * (0.4 + 0.6 * facing), 1.0);
}`;
function meshDrawing(gl, mesh, bytes) {
  const made = glProgram(gl, MESH_VERTEX, MESH_FRAGMENT),
    array = gl.createVertexArray();
  gl.bindVertexArray(array);
  [
    [bytes(mesh.vertices), 3, gl.FLOAT, false],
    [bytes(mesh.rgba), 4, gl.UNSIGNED_BYTE, true],
  ].forEach(([data, size, kind, normalized], location) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, size, kind, normalized, 0, 0);
  });
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, bytes(mesh.faces), gl.STATIC_DRAW);
  gl.bindVertexArray(null);
  return {
    isComplete: () => true,
    draw(eye) {
      setEye(gl, made, eye);
      gl.bindVertexArray(array);
      gl.drawElements(gl.TRIANGLES, 3 * mesh.count, gl.UNSIGNED_INT, 0);
      gl.bindVertexArray(null);
    },
  };
}

/* The image of one camera, spread between the corners of its frustum. */
const PICTURE_VERTEX = `#version 300 es
precision highp float;
${EYE_GLSL}
uniform vec3 place, corners[4];
uniform float scale;
out vec2 uv;
void main() {
  int corner = gl_VertexID == 2 ? 3 : gl_VertexID == 3 ? 2 : gl_VertexID; // a strip; corners go around
  uv = vec2(gl_VertexID & 1, gl_VertexID >> 1);
  gl_Position = clipOf(camFromWorld * (place + scale * corners[corner] - center));
}`;
const PICTURE_FRAGMENT = `#version 300 es
precision mediump float;
uniform sampler2D image;
uniform float opacity;
in vec2 uv;
out vec4 drawn;
void main() { drawn = vec4(opacity * texture(image, uv).rgb, opacity); }`;
const PICTURE_UNIT = 7;
function pictureDrawing(gl) {
  const made = glProgram(gl, PICTURE_VERTEX, PICTURE_FRAGMENT),
    texture = gl.createTexture();
  return {
    put(image) {
      gl.activeTexture(gl.TEXTURE0 + PICTURE_UNIT);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
      for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
        gl.texParameteri(gl.TEXTURE_2D, side, gl.LINEAR);
      for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T])
        gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    },
    draw(eye, { place, corners, scale, opacity }) {
      setEye(gl, made, eye);
      gl.uniform3fv(made.at("place"), place);
      gl.uniform3fv(made.at("corners"), corners);
      gl.uniform1f(made.at("scale"), scale);
      gl.uniform1f(made.at("opacity"), opacity);
      gl.uniform1i(made.at("image"), PICTURE_UNIT);
      gl.bindVertexArray(null);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    },
  };
}
