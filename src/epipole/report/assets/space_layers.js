/* What a 3D view holds, from the page's bytes or its server's to the graphics card. */
/* global byId, bytesOf, gaussianDrawing, unpackedMesh, texturedDrawing */
/* global pointDrawing, lineDrawing, meshDrawing, pictureDrawing, frustumPieces, curvePieces */
/* exported spaceBlocks, spaceLayers, gaussiansOf */
"use strict";
const CAMERA_RGB = [0.56, 0.82, 0.9];

/* A block of bytes of the page, or of the server that the page came from. */
async function spaceBytes(name) {
  const block = byId(`space-${name}`);
  if (block) {
    const bytes = bytesOf(block.textContent);
    block.textContent = ""; // twice in memory is once too often
    return bytes.buffer;
  }
  const answer = await fetch(`data/${name}`);
  if (!answer.ok) throw new Error(`the server no longer has ${name}`);
  return answer.arrayBuffer();
}

/* The bytes of every block that a scene names. */
async function spaceBlocks(data) {
  const blocks = {};
  for (const name of data.blocks) blocks[name] = await spaceBytes(name);
  if (data.mesh && data.mesh.packed) {
    const packed = data.mesh.packed.block;
    Object.assign(blocks, await unpackedMesh(data.mesh, blocks[packed]));
    delete blocks[packed];
  }
  return blocks;
}

/* Everything on the graphics card, with what has to be looked up again kept beside it. `put(data, blocks)` replaces
   points, lines and cameras by those of a scene with the same layers. `late` has functions for what is decoded later. */
function spaceLayers(gl, data, blocks, late) {
  const out = { shown: {}, cameras: null, mesh: null, gaussians: null };
  out.points = data.points.map((layer, k) => {
    out.shown[`points-${k}`] = layer.shown;
    return { drawing: pointDrawing(gl, data.ramp) };
  });
  out.curves = data.curves.map((curve, k) => {
    out.shown[`curve-${k}`] = curve.shown;
    return lineDrawing(gl);
  });
  if (data.cameras) {
    out.cameras = { drawing: lineDrawing(gl) };
    out.shown.cameras = data.cameras.shown;
  }
  out.picture = { drawing: pictureDrawing(gl), of: -1 };
  if (data.mesh) {
    const drawing = data.mesh.textures
      ? texturedDrawing(gl, data.mesh, blocks, late)
      : meshDrawing(gl, data.mesh, (name) => blocks[name]);
    out.mesh = {
      drawing,
      vertices: new Float32Array(blocks[data.mesh.vertices]),
      faces: new Uint32Array(blocks[data.mesh.faces]),
    };
    out.shown.mesh = true;
  }
  if (data.gaussians) {
    out.gaussians = { drawing: gaussianDrawing(gl), ...gaussiansOf(data.gaussians, blocks) };
    out.gaussians.drawing.put(out.gaussians);
    out.shown.gaussians = true;
  }
  out.put = (fresh, found) => {
    const floats = (name) => new Float32Array(found[name]);
    fresh.points.forEach((layer, k) => {
      const rows = floats(layer.rows),
        values = layer.values ? new Uint16Array(found[layer.values]) : null,
        covariances = layer.covariances ? floats(layer.covariances) : null;
      Object.assign(out.points[k], { layer, rows, values, covariances });
      out.points[k].drawing.put(rows, values);
    });
    fresh.curves.forEach((curve, k) => {
      const rgb = curve.rgb.map((v) => v / 255);
      out.curves[k].put(curvePieces(floats(curve.pieces), rgb));
    });
    if (!fresh.cameras) return;
    const [places, axes, corners] = ["places", "axes", "corners"].map((part) => floats(fresh.cameras[part]));
    Object.assign(out.cameras, { places, axes, corners });
    out.cameras.drawing.put(frustumPieces(places, corners, CAMERA_RGB));
  };
  out.put(data, blocks);
  return out;
}

/* Gaussians as they are drawn, sorted and picked. */
function gaussiansOf(numbers, blocks) {
  const words = new Uint32Array(blocks[numbers.rows]),
    harmonics = numbers.harmonics ? new Uint32Array(blocks[numbers.harmonics]) : null,
    floats = new Float32Array(words.buffer),
    places = new Float32Array(3 * numbers.count);
  for (let k = 0; k < numbers.count; k++) places.set(floats.subarray(8 * k, 8 * k + 3), 3 * k);
  return { numbers, words, harmonics, places };
}
