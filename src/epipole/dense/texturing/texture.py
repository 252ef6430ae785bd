"""Texture of a mesh from photographs (Waechter, Moehrle and Goesele, Let There Be Color!, ECCV 2014).

Each face gets the view that shows it largest, with few seams between views (belief propagation on a Potts model). Connected faces with the
same view are a chart, whose texture is copied from the image; smooth color offsets remove the seams between charts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from epipole._checks import checked
from epipole.dense.texturing import _raster_kernels as raster
from epipole.dense.texturing.charts import Atlas, Charts, charts_of, pack
from epipole.dense.texturing.seams import color_offsets
from epipole.dense.texturing.texture_view import TextureView
from epipole.dense.texturing.view_choice import candidate_views, choose_views, face_neighbors
from epipole.dense.view import intrinsics_of
from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.scene import Mesh
from epipole.scene.textured_mesh import TexturedMesh

SIDES = (256, 16384)
"""Smallest and largest side of a texture."""
UNSEEN_GRAY = 128
"""Color of faces that no view shows and that have no neighbor with a color."""


@checked
def texture_mesh(
    mesh: Mesh,
    views: Sequence[TextureView],
    side_px: int = 4096,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> TexturedMesh:
    """Texture a mesh from the views that see it.

    Args:
        mesh: the mesh; the side from which its triangles are counterclockwise is textured.
        views: images with their cameras.
        side_px: width of the texture, and its largest height.
        progress: called with the number of steps done and of all: two for each view.

    Raises:
        ConfigError: side_px is out of range, or too small for the mesh.
        DegenerateGeometryError: no view shows the mesh.
    """
    if not SIDES[0] <= side_px <= SIDES[1]:
        raise ConfigError(f"side_px must be from {SIDES[0]} to {SIDES[1]}, got {side_px}")
    if not len(mesh) or not len(views):
        raise DegenerateGeometryError("there is no face to texture, or no view")
    neighbors = face_neighbors(mesh.faces)
    found = candidate_views(mesh, views, lambda done: progress(done, 2 * len(views)))
    label = choose_views(found, neighbors)
    if not (label >= 0).any():
        raise DegenerateGeometryError("no view shows the mesh")
    charts = charts_of(label, neighbors)
    corners_px, colors = _corners(mesh, views, label)
    atlas = pack(charts, corners_px, side_px)
    offsets = color_offsets(mesh.faces, charts, colors)
    flat = _flat_colors(charts, neighbors, colors + offsets)
    image = np.zeros((atlas.height_px, side_px, 3), np.uint8)
    for n, view in enumerate(views):
        progress(len(views) + n, 2 * len(views))
        own = np.flatnonzero(charts.view == n)
        if len(own):
            _copy_charts(view, own, charts, atlas, corners_px, offsets, image)
    for chart in np.flatnonzero(charts.view < 0).tolist():
        (x, y), (w, h) = atlas.corner[chart], atlas.size[chart]
        image[y : y + h, x : x + w] = flat[chart]
    progress(2 * len(views), 2 * len(views))
    uv = _uv(charts, atlas, corners_px)
    return TexturedMesh(mesh.vertices_in_world, mesh.faces, uv, np.zeros(len(mesh), np.int64), (image,))


def _corners(mesh: Mesh, views: Sequence[TextureView], label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (m, 3, 2) in the full image and colors (m, 3, 3) of the corners of each face in its view; NaN colors without one."""
    pixels, colors = np.zeros((len(label), 3, 2)), np.full((len(label), 3, 3), np.nan)
    for n, view in enumerate(views):
        own = np.flatnonzero(label == n)
        if not len(own):
            continue
        used, corner = np.unique(mesh.faces[own], return_inverse=True)
        corner = corner.reshape(-1, 3)
        in_cam = view.cam_from_world.apply(mesh.vertices_in_world[used])
        k = intrinsics_of(view.full_camera)
        pixels[own] = (in_cam[:, :2] / in_cam[:, 2:] * k[:2] + k[2:])[corner]
        colors[own] = view.colors_at(mesh.vertices_in_world[used])[corner]
    return pixels, colors


def _scaled(pixels: np.ndarray, atlas: Atlas) -> np.ndarray:
    """Pixels of the image at the atlas' scale."""
    return np.asarray((pixels + 0.5) * atlas.scale - 0.5)


def _copy_charts(
    view: TextureView,
    own: np.ndarray,
    charts: Charts,
    atlas: Atlas,
    corners_px: np.ndarray,
    offsets: np.ndarray,
    image: np.ndarray,
) -> None:
    """Copy the charts of a view from its image into the texture, with their color offsets."""
    full = view.read_full()
    size = max(1, round(full.shape[1] * atlas.scale)), max(1, round(full.shape[0] * atlas.scale))
    small = full if size == full.shape[1::-1] else cv2.resize(full, size, interpolation=cv2.INTER_AREA)
    for chart in own.tolist():
        faces, first = charts.faces_of(chart), atlas.origin[chart]
        (x, y), (w, h) = atlas.corner[chart], atlas.size[chart]
        columns = np.clip(np.arange(first[0], first[0] + w), 0, size[0] - 1)
        rows = np.clip(np.arange(first[1], first[1] + h), 0, size[1] - 1)
        part = small[rows[:, None], columns[None]].astype(np.float32)
        more, painted = np.zeros((h, w, 3), np.float32), np.zeros((h, w), np.uint8)
        local = _scaled(corners_px[faces], atlas) - first
        raster.paint_values(local, offsets[faces], more, painted)
        part += _extended(more, painted)
        image[y : y + h, x : x + w] = np.clip(np.rint(part), 0, 255).astype(np.uint8)


def _extended(values: np.ndarray, painted: np.ndarray) -> np.ndarray:
    """Values continued beyond what is painted, by averages of neighbors."""
    for _ in range(3):
        if painted.all():
            break
        known = painted.astype(np.float32)
        total, count = cv2.blur(values * known[..., None], (3, 3)), cv2.blur(known, (3, 3))
        new = (painted == 0) & (count > 0)
        values[new] = total[new] / count[new, None]
        painted[new] = 1
    return values


def _flat_colors(charts: Charts, neighbors: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """(c, 3) mean color of the faces around each chart, for charts that no view shows."""
    total, count = np.zeros((len(charts), 3)), np.zeros(len(charts))
    mean = colors.mean(axis=1)
    face, edge = np.nonzero((neighbors >= 0) & (charts.view[charts.chart_of_face] < 0)[:, None])
    other = neighbors[face, edge]
    known = np.isfinite(mean[other]).all(axis=1)
    chart = charts.chart_of_face[face[known]]
    np.add.at(total, chart, mean[other[known]])
    np.add.at(count, chart, 1.0)
    flat = np.where(count[:, None] > 0, total / np.maximum(count, 1.0)[:, None], UNSEEN_GRAY)
    return np.clip(np.rint(flat), 0, 255).astype(np.uint8)


def _uv(charts: Charts, atlas: Atlas, corners_px: np.ndarray) -> np.ndarray:
    """(m, 3, 2) texture coordinates of the corners of each face."""
    chart = charts.chart_of_face
    texel = _scaled(corners_px, atlas) - atlas.origin[chart][:, None] + atlas.corner[chart][:, None]
    unseen = charts.view[chart] < 0
    texel[unseen] = (atlas.corner[chart[unseen]] + 0.5 * (atlas.size[chart[unseen]] - 1))[:, None]
    return np.asarray(np.clip((texel + 0.5) / [atlas.side_px, atlas.height_px], 0.0, 1.0))
