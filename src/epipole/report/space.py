"""A 3D scene as data for the page's script: named numbers, and blocks of bytes.

All positions are relative to an origin near the scene, in single precision: maps with coordinates of millions of meters
keep millimeter precision.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from PIL import Image

from epipole.image import color_map, downscaled
from epipole.report.gaussian_merging import merged
from epipole.report.gaussians import packed
from epipole.report.markup import axis_words, count, data_uri
from epipole.report.space_scene import (
    CameraLayer,
    FirstView,
    LoadImage,
    MeshLayer,
    PointLayer,
    PointMeasure,
    SpaceScene,
    TexturedMeshLayer,
)
from epipole.report.textured_layer import textured_data
from epipole.scene import Curve, Extent, extent_of, frustum_corners_in_cam, frustum_size

RADIUS_PERCENT = 85.0
FRUSTUM_SIZES = (0.01, 0.12)
"""Range of frustum sizes as a fraction of the scene radius."""
FROM_A_CORNER = np.array([-1.68, -2.06, 1.6])
"""Initial position of the camera relative to the focus, in scene radii."""
RAMP_STOPS = 16
UNKNOWN = 65535
"""Quantized value of an unknown measure."""
IMAGE_SIDE_PX, MOST_IMAGES = 320, 150
"""Longer side of camera images in a page, and the largest number in one file, spread evenly over all cameras."""


@dataclass(frozen=True, slots=True, eq=False)
class SpaceData:
    """The data for the script."""

    numbers: dict[str, Any]
    blocks: dict[str, bytes] = field(default_factory=dict)
    """Blocks of bytes by the names used in `numbers`."""

    def put(self, name: str, array: np.ndarray) -> str:
        """Store an array's bytes under a name, and return the name."""
        self.blocks[name] = np.ascontiguousarray(array).tobytes()
        return name


def space_data(
    scene: SpaceScene,
    most_points: int | None = None,
    most_gaussians: int | None = None,
    origin_in_world: Float64[np.ndarray, " 3"] | None = None,
) -> SpaceData:
    """Convert a scene to data for the script.

    Args:
        scene: the scene.
        most_points: largest number of points per layer, sampled at random.
        most_gaussians: largest number of Gaussians; more are merged.
        origin_in_world: origin of the coordinates; None: the center of the scene, or zero for Gaussians.
    """
    extent = _extent(scene)
    # Gaussians keep the coordinates of their file.
    middle = np.zeros(3) if scene.gaussians is not None else extent.focus.astype(np.float32).astype(float)
    origin = middle if origin_in_world is None else origin_in_world
    rotation = np.eye(3) if scene.upright_from_world is None else scene.upright_from_world
    view = scene.view or FirstView(
        extent.focus + extent.radius * FROM_A_CORNER @ rotation, extent.focus, rotation[2]
    )
    numbers: dict[str, Any] = {
        "title": scene.title,
        "unit": scene.unit,
        "live": None,
        "axes": list(axis_words(is_enu=scene.is_enu)),
        "isEnu": scene.is_enu,
        "scaleWords": "" if scene.unit else ", up to scale",
        "origin": origin.tolist(),
        "position": rounded(view.position - origin),
        "lookAt": rounded(view.look_at - origin),
        "up": rounded(view.up),
        "low": rounded(extent.low - origin),
        "high": rounded(extent.high - origin),
        "radius": float(np.linalg.norm(view.position - view.look_at) / np.linalg.norm(FROM_A_CORNER)),
        "background": scene.background,
        "ramp": (color_map(np.linspace(0.0, 1.0, RAMP_STOPS), (0.0, 1.0)) / 255.0).ravel().tolist(),
    }
    data = SpaceData(numbers)
    numbers["points"] = [_points(data, k, layer, origin, most_points) for k, layer in enumerate(scene.points)]
    numbers["curves"] = [_curve(data, k, curve, origin) for k, curve in enumerate(scene.curves)]
    numbers["cameras"] = _cameras(data, scene.cameras, origin, extent) if scene.cameras is not None else None
    numbers["mesh"] = _mesh(data, scene.mesh, origin) if scene.mesh is not None else None
    numbers["gaussians"] = _gaussians(data, scene, most_gaussians)
    numbers["blocks"] = list(data.blocks)
    return data


def _extent(scene: SpaceScene) -> Extent:
    positions = [
        np.asarray(layer.xyz_in_world[:: max(1, len(layer.xyz_in_world) // 200_000)], float)
        for layer in scene.points
    ]
    if scene.mesh is not None:
        positions.append(np.asarray(scene.mesh.vertices_in_world, float))
    if scene.gaussians is not None:
        positions.append(scene.gaussians.means_in_world.astype(float))
    centers = scene.cameras.cams_from_world.centers() if scene.cameras is not None else np.zeros((0, 3))
    if not any(map(len, positions)) or (scene.curves and not len(centers)):
        positions += [curve.segments_in_world.reshape(-1, 3) for curve in scene.curves]
    return extent_of(np.concatenate([np.zeros((0, 3)), *positions]), centers, RADIUS_PERCENT)


def _points(
    data: SpaceData, k: int, layer: PointLayer, origin: np.ndarray, most: int | None
) -> dict[str, Any]:
    """Points in random order, so that the first ones are a fair sample of all."""
    rows = shuffled(np.flatnonzero(np.isfinite(layer.xyz_in_world).all(axis=1)), most)
    # Position and color together in 16 bytes: read once, in an order that no cache can predict.
    together = np.zeros((len(layer.xyz_in_world), 4), "<u4")
    together[:, :3].view("<f4")[:] = _near(layer.xyz_in_world, origin)
    together.view(np.uint8)[:, 12:15] = layer.rgb
    given = {
        "name": layer.name,
        "shown": layer.is_shown,
        "count": len(rows),
        "whole": len(layer.xyz_in_world),
        "rows": data.put(f"points-{k}", np.take(together, rows, axis=0)),
        "errorWords": layer.error_words,
        "covariances": None,
        "measures": [],
        "values": None,
    }
    if layer.covariances is not None:
        upper = layer.covariances[rows][:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        given["covariances"] = data.put(f"covariances-{k}", np.clip(upper, -3e38, 3e38).astype("<f4"))
    if layer.measures:
        found = [_measure(measure, rows) for measure in layer.measures]
        steps = np.full((len(rows), 2), UNKNOWN, "<u2")
        for column, (_, own) in enumerate(found):
            steps[:, column] = own
        given["measures"] = [description for description, _ in found]
        given["values"] = data.put(f"values-{k}", steps)
    return given


def shuffled(rows: Int64[np.ndarray, " n"], most: int | None = None) -> Int64[np.ndarray, " m"]:
    """Rows in a random but reproducible order, at most `most`."""
    return np.random.default_rng(0).permutation(rows)[: len(rows) if most is None else most]


def _near(positions: np.ndarray, origin: np.ndarray) -> np.ndarray:
    if positions.dtype == np.float32 and not origin.any():
        return positions
    return (positions.astype(np.float64) - origin).astype("<f4")


def _measure(measure: PointMeasure, rows: np.ndarray) -> tuple[dict[str, Any], np.ndarray]:
    """Name and range of a measure, and its values quantized to 65534 steps."""
    values = measure.values[rows]
    known = np.isfinite(values)
    low, high = (float(v) for v in np.percentile(values[known], (0, 99.5))) if known.any() else (0.0, 1.0)
    if measure.is_at_least and known.any():
        high = float(values[known].max())
    span = max(high - low, 1e-12)
    steps = np.full(len(rows), UNKNOWN, np.int64)
    steps[known] = np.clip(np.rint((values[known] - low) / span * (UNKNOWN - 1)), 0, UNKNOWN - 1)
    described = {"name": measure.name, "unit": measure.unit, "low": low, "high": low + span}
    return described | {"isAtLeast": measure.is_at_least}, steps


def _curve(data: SpaceData, k: int, curve: Curve, origin: np.ndarray) -> dict[str, Any]:
    pieces = _near(curve.segments_in_world.reshape(-1, 3), origin)
    return {
        "name": curve.name,
        "rgb": list(curve.rgb),
        "shown": curve.is_shown,
        "count": len(curve.segments_in_world),
        "pieces": data.put(f"curve-{k}", pieces),
    }


def _cameras(data: SpaceData, layer: CameraLayer, origin: np.ndarray, extent: Extent) -> dict[str, Any]:
    """Centers, axes (right and forward) and image corners relative to the centers."""
    centers, rotations = layer.cams_from_world.centers(), layer.cams_from_world.rotation
    cameras = np.concatenate([layer.K.reshape(-1, 9), layer.sizes], axis=1)
    different, of_camera = np.unique(cameras, axis=0, return_inverse=True)
    in_cam = np.array(
        [frustum_corners_in_cam(row[:9].reshape(3, 3), int(row[9]), int(row[10])) for row in different]
    ).reshape(-1, 4, 3)[of_camera.reshape(-1)]
    # From the center to a corner in the world: R^T corner.
    corners = in_cam @ rotations
    return {
        "name": layer.name,
        "shown": layer.is_shown,
        "names": list(layer.names),
        "size": frustum_size(centers, *(fraction * extent.radius for fraction in FRUSTUM_SIZES)),
        "focals": rounded(layer.K[:, 0, 0]),
        "sizes": layer.sizes.tolist(),
        "places": data.put("camera-places", (centers - origin).astype("<f4")),
        "axes": data.put("camera-axes", rotations[:, [0, 2]].astype("<f4")),
        "corners": data.put("camera-corners", corners.astype("<f4")),
        "images": None,
        "depths": None,
    }


def _mesh(data: SpaceData, mesh: MeshLayer | TexturedMeshLayer, origin: np.ndarray) -> dict[str, Any]:
    if isinstance(mesh, TexturedMeshLayer):
        return textured_data(data.put, mesh, origin)
    rgba = np.full((len(mesh.rgb), 4), 255, np.uint8)
    rgba[:, :3] = mesh.rgb
    return {
        "name": mesh.name,
        "count": len(mesh.faces),
        "vertices": data.put("mesh-vertices", _near(mesh.vertices_in_world, origin)),
        "rgba": data.put("mesh-rgba", rgba),
        "faces": data.put("mesh-faces", mesh.faces.astype("<u4")),
        "packed": None,
        "textures": None,
    }


def _gaussians(data: SpaceData, scene: SpaceScene, most: int | None) -> dict[str, Any] | None:
    if scene.gaussians is None:
        return None
    cloud = scene.gaussians
    if most is not None:
        cloud = merged(cloud, most)
    found = packed(cloud)
    data.blocks["gaussians"] = found.rows
    if found.harmonics is not None:
        data.blocks["harmonics"] = found.harmonics
    return {
        "name": "Gaussians",
        "count": len(cloud),
        "whole": len(scene.gaussians),
        "rows": "gaussians",
        "harmonics": "harmonics" if found.harmonics is not None else None,
        "scaleRange": found.scale_range,
        "colorRange": found.color_range,
        "harmonicRange": found.harmonic_range,
    }


def embedded_images(layer: CameraLayer, most: int = MOST_IMAGES) -> list[str | None]:
    """Small images of the cameras as data URIs; None where an image is missing, or beyond `most`."""
    out: list[str | None] = [None] * len(layer.names)
    if layer.load_image is None or not layer.names:
        return out
    for row in np.unique(np.linspace(0, len(out) - 1, min(most, len(out))).astype(int)).tolist():
        jpeg = small_jpeg(layer.load_image, layer.names[row])
        out[row] = data_uri(jpeg, "image/jpeg") if jpeg is not None else None
    return out


def small_jpeg(load_image: LoadImage, name: str) -> bytes | None:
    """A camera's image downscaled for a page; None if it is missing."""
    rgb = load_image(name)
    if rgb is None:
        return None
    stream = io.BytesIO()
    Image.fromarray(downscaled(rgb, IMAGE_SIDE_PX)).save(stream, "JPEG", quality=80)
    return stream.getvalue()


def rounded(values: Float64[np.ndarray, " n"]) -> list[float]:
    """Numbers rounded to seven digits."""
    return [float(f"{v:.7g}") for v in values]


def of_all(shown: int, whole: int) -> str:
    """A count as text: `shown` or `shown of whole`."""
    return count(shown) if shown == whole else f"{count(shown)} of {count(whole)}"
