"""Images of a textured mesh."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, UInt8

from epipole._checks import checked
from epipole.cameras import Camera
from epipole.dense.texturing import _raster_kernels as raster
from epipole.dense.texturing.sampling import colors_at
from epipole.dense.view import intrinsics_of
from epipole.geometry import Rigid3
from epipole.scene.textured_mesh import TexturedMesh


@checked
def render_textured(
    mesh: TexturedMesh, camera: Camera, cam_from_world: Rigid3
) -> tuple[UInt8[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
    """Image and depth of a textured mesh, without light; black and NaN where it is not.

    Args:
        mesh: the mesh.
        camera: a pinhole camera.
        cam_from_world: its pose.
    """
    k = intrinsics_of(camera)
    in_cam = cam_from_world.apply(mesh.vertices_in_world)
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = in_cam[:, :2] / in_cam[:, 2:] * k[:2] + k[2:]
    inverse = np.zeros((camera.height, camera.width), np.float32)
    nearest = np.full(inverse.shape, -1, np.int32)
    raster.render_faces(pixels, in_cam[:, 2].copy(), mesh.faces, inverse, nearest)
    rgb = texture_colors(mesh, pixels, nearest, in_cam[:, 2])
    with np.errstate(divide="ignore"):
        depth = np.where(nearest >= 0, 1.0 / inverse, np.float32(np.nan))
    return rgb, depth.astype(np.float32)


def texture_colors(
    mesh: TexturedMesh, pixels: np.ndarray, face_of_pixel: np.ndarray, depth: np.ndarray | None
) -> np.ndarray:
    """(h, w, 3) colors of the pixels that show a face; black elsewhere.

    Args:
        mesh: the mesh.
        pixels: (n, 2) of its vertices.
        face_of_pixel: (h, w) face, -1 for none.
        depth: (n,) of the vertices; None: parallel projection.
    """
    row, column = np.nonzero(face_of_pixel >= 0)
    face = face_of_pixel[row, column]
    weights = _barycentric(np.stack([column, row], axis=1), pixels[mesh.faces[face]])
    if depth is not None:  # u/z is linear in the image, u is not
        weights /= depth[mesh.faces[face]]
        weights /= weights.sum(axis=1, keepdims=True)
    uv = (weights[..., None] * mesh.uv[face]).sum(axis=1)
    rgb = np.zeros((*face_of_pixel.shape, 3), np.uint8)
    for n, texture in enumerate(mesh.textures):
        own = mesh.texture_of_face[face] == n
        rgb[row[own], column[own]] = _sampled(texture, uv[own])
    return rgb


def _barycentric(at: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(n, 3) weights of pixels (n, 2) in triangles (n, 3, 2)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    wa = (b - at)[:, 0] * (c - at)[:, 1] - (b - at)[:, 1] * (c - at)[:, 0]
    wb = (c - at)[:, 0] * (a - at)[:, 1] - (c - at)[:, 1] * (a - at)[:, 0]
    wa, wb = wa / area, wb / area
    return np.stack([wa, wb, 1.0 - wa - wb], axis=1)


def _sampled(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear colors (n, 3) at texture coordinates (n, 2)."""
    height, width = texture.shape[:2]
    return colors_at(texture, (uv * [width, height] - 0.5).astype(np.float32))
