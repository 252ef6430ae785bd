"""Viewer scenes of SLAM results: trajectory, keyframes, points and loops."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from epipole.dense.volume_building import GRAY
from epipole.errors import EpipoleError, FileFormatError
from epipole.image import color_map
from epipole.io.convert import read_model
from epipole.io.files import read_json
from epipole.io.images.photographs import read_rgb
from epipole.io.meshes.mesh_ply import read_mesh_ply
from epipole.io.names import path_inside
from epipole.io.sequences.sequence import read_sequence
from epipole.io.trajectories.files import read_trajectory, trajectory_format
from epipole.io.trajectories.frame_tables import FRAME_TABLE, read_frame_table
from epipole.pipelines.slam.output.map_file import MAP_FILE, summary_of_map
from epipole.pipelines.slam.output.meshing import MESH
from epipole.pipelines.slam.output.rendering import (
    CAUSAL,
    CAUSAL_RGB,
    FINAL,
    FINAL_RGB,
    loop_curve,
    path_curve,
    upright_from_world,
)
from epipole.report.markup import plural
from epipole.report.space_model import scene_of_model
from epipole.report.space_scene import (
    METERS,
    NO_UNIT,
    CameraLayer,
    MeshLayer,
    PointLayer,
    PointMeasure,
    SpaceScene,
)
from epipole.runs.folder import read_mark

TRAJECTORY, CAUSAL_TRAJECTORY = "trajectory.txt", "trajectory_causal.txt"
IMAGE_PX = 640
UNIT_OF_FILE = "units of the file"
MANY_POSITIONS = 300


def is_mine(path: Path) -> bool:
    """Whether a folder contains the results of a SLAM run."""
    return (path / CAUSAL_TRAJECTORY).is_file() and (path / TRAJECTORY).is_file()


def scene(path: Path) -> SpaceScene:
    """Points, keyframes (with images that still exist), trajectories and loops of a run.

    Raises:
        FileFormatError: there is no map, or a file is damaged.
    """
    if not (path / "sparse" / "0").is_dir():
        raise FileFormatError(path, "contains no map, as after a run with a single keyframe")
    model = read_model(path / "sparse" / "0")
    final, causal = read_trajectory(path / TRAJECTORY), read_trajectory(path / CAUSAL_TRAJECTORY)
    numbers = _frame_numbers(path)
    summary = _summary(path)
    loops = loop_curve(_loops(summary), model, [numbers.get(name, -1) for name in model.images.name])
    curves = (
        path_curve(FINAL, final, FINAL_RGB),
        path_curve(CAUSAL, causal, CAUSAL_RGB, is_shown=False),
        loops,
    )
    found = scene_of_model(
        model,
        title=path.resolve().name,
        unit=METERS if summary.get("is_metric") is True else NO_UNIT,
        cameras="Keyframes",
        load_image=image_loader(path),
        curves=curves,
    )
    upright = upright_from_world(final.world_from_body).rotation
    return replace(found, mesh=_mesh(path), upright_from_world=upright)


def _mesh(path: Path) -> MeshLayer | None:
    """The mesh of the keyframes' depth, if there is one.

    Raises:
        FileFormatError: the file is damaged.
    """
    if not (path / MESH).is_file():
        return None
    found = read_mesh_ply(path / MESH)
    rgb = np.full((len(found.xyz), 3), GRAY, np.uint8) if found.rgb is None else found.rgb
    return MeshLayer("Mesh", found.xyz, found.faces, rgb) if len(found.faces) else None


def is_trajectory(path: Path) -> bool:
    """Whether a file is a trajectory in TUM, KITTI or EuRoC format."""
    if path.suffix.lower() not in (".txt", ".csv", ".tum", ".kitti") or not path.is_file():
        return False
    try:
        trajectory_format(path)
    except FileFormatError:
        return False
    return True


def scene_of_trajectory(path: Path) -> SpaceScene:
    """Positions of a trajectory, colored by time.

    If the first pose is the identity, the bodies are assumed to be cameras whose images are upright on average; in any other
    world (of a map, of a survey) +z is up.

    Raises:
        FileFormatError: the file is damaged, or contains no pose.
    """
    found = read_trajectory(path)
    if not len(found):
        raise FileFormatError(path, "contains no pose")
    starts_at_first = np.abs(found.world_from_body[0].as_matrix() - np.eye(4)).max() < 1e-3
    upright = upright_from_world(found.world_from_body).rotation if starts_at_first else None
    covariances = None
    if found.covariance is not None:
        rotated = found.world_from_body.rotation
        covariances = rotated @ found.covariance[:, :3, :3] @ np.swapaxes(rotated, 1, 2)
    times = found.timestamp_s - found.timestamp_s[0]
    has_times = trajectory_format(path) != "kitti"  # which has line numbers only
    instants = PointLayer(
        "Positions",
        found.world_from_body.translation,
        color_map(times),
        (PointMeasure("time", times, "s") if has_times else PointMeasure("number", times),),
        covariances,
        "as given in the file",
    )
    over = f" over {times[-1]:.1f} s" if has_times else ""
    return SpaceScene(
        title=path.resolve().name,
        words=f"{plural(len(found), 'pose')}{over}, trajectory length {found.path_length():.4g}",
        unit=UNIT_OF_FILE,
        points=(instants,),
        # Many positions form a line, and a curve on top would hide their colors.
        curves=(path_curve("trajectory", found, FINAL_RGB, is_shown=len(found) < MANY_POSITIONS),),
        upright_from_world=upright,
    )


def is_map(path: Path) -> bool:
    """Whether a path is a map file, or the `map` folder of a run."""
    return (path.is_file() and path.suffix == ".npz") or (path / MAP_FILE.name).is_file()


def scene_of_map(path: Path) -> SpaceScene:
    """Points and keyframes of a map, with the keyframe images that it stores.

    Raises:
        FileFormatError: the file is not a map, or damaged.
    """
    found = summary_of_map(path)
    upright = upright_from_world(found.cams_from_world.inverse()).rotation
    points = found.xyz_in_world
    rgb = np.full((len(points), 3), 200, np.uint8)
    agreed = PointMeasure("agreeing frames", found.num_agreed.astype(np.float64), "", is_at_least=True)
    images = dict(zip(found.names, found.gray))
    n = len(found.names)
    keyframes = CameraLayer(
        "Keyframes",
        found.names,
        found.cams_from_world,
        np.broadcast_to(found.camera.K, (n, 3, 3)).copy(),
        np.broadcast_to([found.camera.width, found.camera.height], (n, 2)).copy(),
        lambda name: np.repeat(images[name][..., None], 3, axis=2),
    )
    words = f"A map of {plural(n, 'keyframe')} and {plural(len(points), 'point')}"
    unit = METERS if found.is_metric else NO_UNIT
    layers = (PointLayer("Points", points, rgb, (agreed,)),)
    return SpaceScene(path.resolve().name, words, unit, layers, keyframes, upright_from_world=upright)


def image_loader(out: Path) -> Callable[[str], np.ndarray | None]:
    """Function that reads a keyframe's image from the run's source, or returns None if it is gone."""
    mark = read_mark(out)
    files: dict[str, Path] = {}
    source = mark.source.paths[0] if mark is not None and mark.source.paths else None
    if source is not None:
        try:
            frames = read_sequence(source).frames
        except EpipoleError:
            frames = ()
        files = {frame.image.name: frame.image for frame in frames}

    def load_image(name: str) -> np.ndarray | None:
        try:
            if name not in files and source is not None:
                return _image_of_rig(Path(source), name)
            return read_rgb(files[name], IMAGE_PX) if name in files else None
        except FileFormatError:
            return None

    return load_image


def _image_of_rig(source: Path, name: str) -> np.ndarray | None:
    """The image of one of a rig's cameras, whose name contains its folder, such as cam1/0001.png."""
    found = [path_inside(folder, name) for folder in (source, source / "mav0")]
    file = next((path for path in found if path.is_file()), None)
    return None if file is None else read_rgb(file, IMAGE_PX)


def _summary(path: Path) -> dict[str, Any]:
    summary = read_json(path / "summary.json")
    return summary if isinstance(summary, dict) else {}


def _loops(summary: dict[str, Any]) -> list[dict[str, Any]]:
    """Loops of the summary; empty if it has none."""
    loops = summary.get("loops", [])
    return [loop for loop in loops if isinstance(loop, dict)] if isinstance(loops, list) else []


def _frame_numbers(path: Path) -> dict[str, int]:
    """Frame numbers by image name; dropped and left-out frames are not counted."""
    if not (path / FRAME_TABLE).is_file():
        return {}
    table = read_frame_table(path / FRAME_TABLE)
    tracked = np.flatnonzero(np.isfinite(table.timestamp_s))
    return {table.image[row]: number for number, row in enumerate(tracked)}
