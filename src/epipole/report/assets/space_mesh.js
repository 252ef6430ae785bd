/* Triangles with textures: unpacking, and drawing without light. */
/* global glProgram, EYE_GLSL, setEye */
/* exported unpackedMesh, texturedDrawing */
"use strict";

/* The blocks of a packed mesh: vertices, texture coordinates and faces. */
async function unpackedMesh(mesh, packed) {
  if (typeof DecompressionStream === "undefined")
    throw new Error("this browser cannot decompress the mesh; a newer one can");
  const { corners, low: first, step } = mesh.packed,
    stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate")),
    bytes = new Uint8Array(await new Response(stream).arrayBuffer()),
    vertices = new Float32Array(3 * corners),
    uv = new Float32Array(2 * corners),
    faces = new Uint32Array(3 * mesh.count);
  for (let column = 0; column < 5; column++) {
    const [out, width, offset] = column < 3 ? [vertices, 3, column] : [uv, 2, column - 3],
      [lower, upper] = [2 * column * corners, (2 * column + 1) * corners];
    for (let k = 0, value = 0; k < corners; k++) {
      const zigzag = bytes[lower + k] | (bytes[upper + k] << 8);
      value = (value + ((zigzag >> 1) ^ -(zigzag & 1))) & 65535;
      out[width * k + offset] = first[column] + step[column] * value;
    }
  }
  const at = 10 * corners,
    count = faces.length;
  for (let k = 0, unused = 0; k < count; k++) {
    const low = bytes[at + k] | (bytes[at + count + k] << 8),
      back = low | (bytes[at + 2 * count + k] << 16) | (bytes[at + 3 * count + k] << 24);
    faces[k] = unused - back;
    if (back === 0) unused++;
  }
  return { [mesh.vertices]: vertices.buffer, [mesh.uv]: uv.buffer, [mesh.faces]: faces.buffer };
}

const TEXTURED_VERTEX = `#version 300 es
precision highp float;
${EYE_GLSL}
layout(location = 0) in vec3 place;
layout(location = 1) in vec2 corner;
out vec2 uv;
out vec3 at;
void main() {
  gl_Position = clipOf(camFromWorld * (place - center));
  uv = corner;
  at = place;
}`;
const TEXTURED_FRAGMENT = `#version 300 es
precision highp float;
${EYE_GLSL}
uniform sampler2D image;
in vec2 uv;
in vec3 at;
out vec4 drawn;
void main() {
  if (isCut(at)) discard;
  drawn = vec4(texture(image, uv).rgb, 1.0);
}`;
const MESH_UNIT = 6;
const UNDECODED = new Uint8Array([128, 128, 128, 255]); // until the texture is decoded

/* `changed()` is called when a texture is there, `failed(message)` if the browser cannot decode it. */
function texturedDrawing(gl, mesh, blocks, { changed, failed }) {
  const made = glProgram(gl, TEXTURED_VERTEX, TEXTURED_FRAGMENT),
    array = gl.createVertexArray(),
    largest = gl.getParameter(gl.MAX_TEXTURE_SIZE),
    sharp = gl.getExtension("EXT_texture_filter_anisotropic"),
    edge = mesh.repeats ? gl.REPEAT : gl.CLAMP_TO_EDGE;
  let left = mesh.textures.length;
  gl.bindVertexArray(array);
  [
    [blocks[mesh.vertices], 3],
    [blocks[mesh.uv], 2],
  ].forEach(([data, size], location) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, size, gl.FLOAT, false, 0, 0);
  });
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, blocks[mesh.faces], gl.STATIC_DRAW);
  gl.bindVertexArray(null);

  const bind = (texture) => {
    gl.activeTexture(gl.TEXTURE0 + MESH_UNIT);
    gl.bindTexture(gl.TEXTURE_2D, texture);
  };
  const parts = mesh.textures.map((own) => {
    const texture = gl.createTexture();
    bind(texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, UNDECODED);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, edge);
    if (sharp) {
      const most = gl.getParameter(sharp.MAX_TEXTURE_MAX_ANISOTROPY_EXT);
      gl.texParameterf(gl.TEXTURE_2D, sharp.TEXTURE_MAX_ANISOTROPY_EXT, Math.min(4, most));
    }
    decode(own, texture).then(
      () => {
        left--;
        changed();
      },
      (error) => {
        left--;
        failed(`A texture cannot be shown here: ${error.message}.`);
      },
    );
    return { ...own, texture };
  });
  async function decode({ block, width, height }, texture) {
    const scale = Math.min(1, largest / Math.max(width, height)),
      options = { premultiplyAlpha: "none", colorSpaceConversion: "none" };
    if (scale < 1)
      Object.assign(options, {
        resizeWidth: Math.max(1, Math.floor(scale * width)),
        resizeHeight: Math.max(1, Math.floor(scale * height)),
        resizeQuality: "high",
      });
    const image = await createImageBitmap(new Blob([blocks[block]], { type: "image/jpeg" }), options);
    bind(texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
    gl.generateMipmap(gl.TEXTURE_2D);
    image.close();
    blocks[block] = null; // on the graphics card now
  }
  return {
    isComplete: () => left === 0,
    draw(eye) {
      setEye(gl, made, eye);
      gl.uniform1i(made.at("image"), MESH_UNIT);
      gl.bindVertexArray(array);
      for (const { texture, first, count } of parts) {
        bind(texture);
        gl.drawElements(gl.TRIANGLES, 3 * count, gl.UNSIGNED_INT, 12 * first);
      }
      gl.bindVertexArray(null);
    },
  };
}
