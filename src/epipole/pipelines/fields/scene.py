"""Scene of trained Gaussians for the viewer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from epipole.errors import FileFormatError
from epipole.fields.nerf.voxel_field import gaussians_of
from epipole.fields.training_view import TrainingView
from epipole.geometry import Rigid3
from epipole.io.files import read_json
from epipole.io.gaussians.files import META, gaussians_file, is_unpacked_sog, read_gaussians
from epipole.io.gaussians.files import SPLAT as SPLAT
from epipole.io.models.transforms import model_of_cameras, write_transforms
from epipole.pipelines.fields.cameras import RenderView, render_views_of_model
from epipole.pipelines.fields.config import RenderConfig
from epipole.pipelines.fields.kinds import kind_in
from epipole.report.gaussians import DEGREE_KEPT
from epipole.report.markup import plural
from epipole.report.space_scene import CameraLayer, FirstView, SpaceScene
from epipole.scene import Georeference, Points
from epipole.scene.gaussian_cloud import GaussianCloud

SUMMARY, CAMERAS = "summary.json", "cameras.json"
FIRST_VIEW, ANTIALIASED = "first_view", "antialiased"
"""Keys in the summary."""
MOST_SHOWN = 800_000
"""Gaussians shown for a grid, at most."""
BACKGROUNDS = {"white": 1.0, "black": 0.0}
UNIT, UNIT_OF_FILE = "units of the cameras", "units of the file"
"""Units shown in the viewer; meters only if the cameras are metric."""


def is_mine(path: Path) -> bool:
    """Whether a path is a folder with Gaussians, a grid, a neural field or an unpacked SOG, or a file of Gaussians."""
    if path.suffix.lower() in (".spz", ".sog", ".splat") and path.is_file():
        return True
    if path.suffix.lower() == ".ply" and path.is_file():
        with path.open("rb") as stream:
            head = stream.read(8192)
        return b" f_dc_0" in head or b" packed_position" in head
    if is_unpacked_sog(path) or is_unpacked_sog(path / META):
        return True
    return (path / SPLAT).is_file() or kind_in(path) is not None


def scene(path: Path) -> SpaceScene:
    """Gaussians of an output folder or a file, or those that approximate a grid, with the training cameras if known.

    Raises:
        FileFormatError: a file is damaged.
    """
    cloud, view = seen_gaussians(path)
    origin = cloud.origin_in_world
    view = replace(view, position=view.position - origin, look_at=view.look_at - origin)
    folder = path if path.is_dir() else path.parent
    views: list[RenderView] = []
    if is_result(path) and (folder / CAMERAS).is_file():
        views = render_views_of_model(folder / CAMERAS, RenderConfig())
    is_field = kind_in(path) is not None and not (path / SPLAT).is_file()
    stands_for = " that coarsely approximate a radiance field" if is_field else ""
    return SpaceScene(
        title=path.resolve().name,
        words=f"{plural(len(cloud), 'Gaussian')}{stands_for}; {colors_in_words(cloud.sh_degree)}",
        unit=UNIT if views else UNIT_OF_FILE,
        cameras=cameras_of(views, origin) if views else None,
        gaussians=cloud,
        view=view,
        background=recorded_background(folder / SUMMARY) or 0.0,
    )


def scene_of_training(path: Path, first_view: dict[str, list[float]], background: float) -> SpaceScene:
    """The same for an output folder whose summary is not written yet.

    Args:
        path: output folder with the field and its cameras.
        first_view: from `first_view_of`.
        background: gray value from 0 to 1.
    """
    found = scene(path)
    origin = np.zeros(3) if found.gaussians is None else found.gaussians.origin_in_world
    position, target, up = (np.array(first_view[name]) for name in ("position", "look_at", "up"))
    return replace(found, view=FirstView(position - origin, target - origin, up), background=background)


def is_result(path: Path) -> bool:
    """Whether a path is the output of a training, beside whose files its cameras are."""
    return path.is_dir() or path.name == SPLAT or kind_in(path) is not None


def seen_gaussians(path: Path) -> tuple[GaussianCloud, FirstView]:
    """Gaussians of an output folder or a file, or those that approximate a grid, and the first view.

    Raises:
        FileFormatError: a file is damaged, or has no Gaussians.
    """
    cloud, file = _gaussians_in(path, MOST_SHOWN)
    if not len(cloud):
        raise FileFormatError(file, "has no Gaussians")
    known = recorded_first_view(file.with_name(SUMMARY))
    return cloud, FirstView(*(known or first_view_of_positions(cloud.centers_in_world)))


def colors_in_words(degree: int) -> str:
    """Description of the harmonics that the browser renders."""
    if degree == 0:
        return "colors do not depend on the direction"
    if degree <= DEGREE_KEPT:
        return "view-dependent colors, as trained"
    return f"view-dependent colors with harmonics up to degree {DEGREE_KEPT}, of {degree} in training"


def cameras_of(
    views: Sequence[RenderView] | Sequence[TrainingView], origin_in_world: np.ndarray | None = None
) -> CameraLayer:
    """Camera layer, relative to the Gaussians' origin; hidden at first, as cameras occlude what they see."""
    origin = np.zeros(3) if origin_in_world is None else origin_in_world
    positions = [render_view.cam_from_world @ Rigid3(np.eye(3), origin) for render_view in views]
    return CameraLayer(
        "Cameras",
        tuple(render_view.name for render_view in views),
        Rigid3(np.stack([p.rotation for p in positions]), np.stack([p.translation for p in positions])),
        np.array([render_view.camera.K for render_view in views]),
        np.array([[render_view.camera.width, render_view.camera.height] for render_view in views]),
        is_shown=False,
    )


def gaussians_in(path: Path, most: int) -> GaussianCloud:
    """Gaussians of an output folder or a file; of a field, at most `most`.

    Raises:
        FileFormatError: there is no such file, or it is damaged.
    """
    return _gaussians_in(path, most)[0]


def _gaussians_in(path: Path, most: int) -> tuple[GaussianCloud, Path]:
    """Gaussians, and the file that they or the field are in."""
    found = kind_in(path)
    if found is not None:
        kind, file = found
        return gaussians_of(kind.voxels(kind.read(file)), most), file
    file = gaussians_file(path)
    return read_gaussians(file), file


def first_view_of_positions(positions: np.ndarray) -> list[np.ndarray]:
    """Position, target and up vector for positions (n, 3) without images; assumes y down, as in most such files."""
    middle = np.median(positions, axis=0)
    size = float(np.percentile(np.linalg.norm(positions - middle, axis=1), 90.0))
    away = 2.5 * max(size, 1e-6) * np.array([0.0, -0.3, -1.0])
    return [middle + away, middle, np.array([0.0, -1.0, 0.0])]


def first_view_of(
    positions: np.ndarray, views: Sequence[TrainingView], origin_in_world: np.ndarray | None = None
) -> dict[str, list[float]]:
    """Position, target and up vector of the first view, for the summary.

    Args:
        positions: (n, 3) positions in the scene.
        views: cameras.
        origin_in_world: origin of both; the result is in world coordinates.
    """
    origin = np.zeros(3) if origin_in_world is None else origin_in_world
    world_from_camera = views[0].cam_from_world.inverse()
    up = -np.mean([view.cam_from_world.rotation[1] for view in views], axis=0)
    middle = np.median(positions.astype(np.float64), axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    position = world_from_camera.translation + origin
    return {"position": position.tolist(), "look_at": (middle + origin).tolist(), "up": up.tolist()}


def write_cameras(
    path: Path,
    views: Sequence[TrainingView],
    origin_in_world: np.ndarray | None = None,
    georeference: Georeference | None = None,
) -> None:
    """Write the undistorted training cameras, at the training resolution, as a transforms.json.

    Args:
        path: the file.
        views: cameras.
        origin_in_world: origin of their coordinates, recorded in the file if not zero.
        georeference: position of the world's origin on Earth, recorded in the file if it is known.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    origin = None if origin_in_world is None or not origin_in_world.any() else origin_in_world
    shift = Rigid3(np.eye(3), np.zeros(3) if origin is None else -origin)
    positions = [view.cam_from_world @ shift for view in views]
    cams_from_world = Rigid3(
        np.stack([position.rotation for position in positions]),
        np.stack([position.translation for position in positions]),
    )
    cameras = [view.camera for view in views]
    none = Points(np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0))
    names, rows = [view.name for view in views], list(range(len(views)))
    model = model_of_cameras(names, cameras, rows, cams_from_world, none)
    model = replace(model, georeference=georeference)
    write_transforms(model, path, image_folder="", origin_in_world=origin)


def recorded_background(summary: Path) -> float | None:
    """Gray value of the training background; None if not recorded."""
    recorded = _given(summary, "background")
    return BACKGROUNDS.get(recorded) if isinstance(recorded, str) else None


def recorded_antialiased(summary: Path) -> bool:
    """Whether Gaussians were trained with Mip-Splatting's filter."""
    return _given(summary, ANTIALIASED) is True


def _given(summary: Path, name: str) -> Any:
    try:
        content = read_json(summary)
    except FileFormatError:
        return None
    return content.get(name) if isinstance(content, dict) else None


def recorded_first_view(summary: Path) -> list[np.ndarray] | None:
    """Position, target and up vector; None if not recorded or invalid."""
    try:
        content: Any = read_json(summary)
        recorded = [np.array(content[FIRST_VIEW][name], np.float64) for name in ("position", "look_at", "up")]
    except (FileFormatError, OSError, KeyError, TypeError, ValueError):
        return None
    good = all(part.shape == (3,) and np.isfinite(part).all() for part in recorded)
    return recorded if good and np.linalg.norm(recorded[0] - recorded[1]) > 0 and recorded[2].any() else None
