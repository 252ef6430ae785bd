/* What a 3D view holds, from the page's bytes or its server's to the graphics card. */
/* global byId, bytesOf, gaussianDrawing */
/* global pointDrawing, lineDrawing, meshDrawing, pictureDrawing, frustumPieces, curvePieces */
/* exported spaceLayers */
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

/* Everything on the graphics card, and what has to be looked up again kept beside it. */
async function spaceLayers(gl, data) {
  const out = { points: [], curves: [], shown: {}, cameras: null, mesh: null, gaussians: null };
  const floats = async (name) => new Float32Array(await spaceBytes(name));
  for (const [k, layer] of data.points.entries()) {
    const rows = await floats(layer.rows),
      values = layer.values ? new Uint16Array(await spaceBytes(layer.values)) : null,
      covariances = layer.covariances ? await floats(layer.covariances) : null;
    const drawing = pointDrawing(gl, rows, values, data.ramp);
    out.points.push({ layer, drawing, rows, values, covariances });
    out.shown[`points-${k}`] = true;
  }
  for (const [k, curve] of data.curves.entries()) {
    const rgb = curve.rgb.map((v) => v / 255);
    out.curves.push(lineDrawing(gl, curvePieces(await floats(curve.pieces), rgb)));
    out.shown[`curve-${k}`] = curve.shown;
  }
  if (data.cameras) {
    const [places, axes, corners] = [
      await floats(data.cameras.places),
      await floats(data.cameras.axes),
      await floats(data.cameras.corners),
    ];
    const drawing = lineDrawing(gl, frustumPieces(places, corners, CAMERA_RGB));
    out.cameras = { drawing, places, axes, corners };
    out.shown.cameras = data.cameras.shown;
  }
  out.picture = { drawing: pictureDrawing(gl), of: -1 };
  if (data.mesh) {
    const vertices = await floats(data.mesh.vertices),
      faces = new Uint32Array(await spaceBytes(data.mesh.faces)),
      rgba = new Uint8Array(await spaceBytes(data.mesh.rgba)),
      blocks = { [data.mesh.vertices]: vertices, [data.mesh.faces]: faces, [data.mesh.rgba]: rgba };
    out.mesh = { drawing: meshDrawing(gl, data.mesh, (name) => blocks[name]), vertices, faces };
    out.shown.mesh = true;
  }
  if (data.gaussians) {
    const words = new Uint32Array(await spaceBytes(data.gaussians.rows)),
      harmonics = data.gaussians.harmonics
        ? new Uint32Array(await spaceBytes(data.gaussians.harmonics))
        : null,
      numbers = new Float32Array(words.buffer),
      places = new Float32Array(3 * data.gaussians.count);
    for (let k = 0; k < data.gaussians.count; k++) places.set(numbers.subarray(8 * k, 8 * k + 3), 3 * k);
    out.gaussians = { drawing: gaussianDrawing(gl, data.gaussians, words, harmonics), words, places };
    out.shown.gaussians = true;
  }
  return out;
}
