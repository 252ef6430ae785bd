/* WebGL2 as all drawings of a 3D view use it: programs, the eye, and depth without a far end. */
/* exported glProgram, EYE_GLSL, setEye, glTarget */
"use strict";
/* A place of the world in the eye's frame (x right, y down, z ahead), and on the canvas. What is nearer than `near`
   is cut off; depth runs to infinity. `isCut` tells what a section leaves out. */
const EYE_GLSL = `
uniform mat3 camFromWorld;
uniform vec3 center, boxLow, boxHigh;
uniform vec2 size;
uniform float focal, near;
bool isCut(vec3 place) { return any(lessThan(place, boxLow)) || any(greaterThan(place, boxHigh)); }
vec4 clipOf(vec3 p) { return vec4(2.0 * focal * p.xy / size * vec2(1.0, -1.0), p.z - 2.0 * near, p.z); }
`;

/* Drawings of one kind share a program: to compile one takes long in software. */
const programs = new WeakMap();
function glProgram(gl, vertex, fragment) {
  if (!programs.has(gl)) programs.set(gl, new Map());
  const made = programs.get(gl);
  if (!made.has(vertex)) made.set(vertex, newProgram(gl, vertex, fragment));
  return made.get(vertex);
}
function newProgram(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [
    [gl.VERTEX_SHADER, vertex],
    [gl.FRAGMENT_SHADER, fragment],
  ]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  const known = new Map();
  const at = (name) => {
    if (!known.has(name)) known.set(name, gl.getUniformLocation(program, name));
    return known.get(name);
  };
  return { program, at };
}

/* An eye is { basis: { r, d, f, o }, focal, near, box: { low, high } }. */
function setEye(gl, { program, at }, { basis, focal, near, box }) {
  gl.useProgram(program);
  gl.uniformMatrix3fv(at("camFromWorld"), true, [...basis.r, ...basis.d, ...basis.f]);
  gl.uniform3fv(at("center"), basis.o);
  gl.uniform3fv(at("boxLow"), box.low);
  gl.uniform3fv(at("boxHigh"), box.high);
  gl.uniform2f(at("size"), gl.drawingBufferWidth, gl.drawingBufferHeight);
  gl.uniform1f(at("focal"), focal);
  gl.uniform1f(at("near"), near);
}

/* An image that is drawn in several steps, and shown after each. */
function glTarget(gl) {
  const frame = gl.createFramebuffer(),
    sides = { width: 0, height: 0 };
  let buffers = [];
  function resize(width, height) {
    buffers.forEach((buffer) => gl.deleteRenderbuffer(buffer));
    Object.assign(sides, { width, height });
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    buffers = [
      [gl.RGBA8, gl.COLOR_ATTACHMENT0],
      [gl.DEPTH_COMPONENT24, gl.DEPTH_ATTACHMENT],
    ].map(([form, place]) => {
      const buffer = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
      gl.renderbufferStorage(gl.RENDERBUFFER, form, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, place, gl.RENDERBUFFER, buffer);
      return buffer;
    });
  }
  return {
    bind(width, height) {
      if (width !== sides.width || height !== sides.height) resize(width, height);
      gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
      gl.viewport(0, 0, width, height);
    },
    show() {
      const { width, height } = sides;
      gl.bindFramebuffer(gl.READ_FRAMEBUFFER, frame);
      gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
      gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    },
  };
}
