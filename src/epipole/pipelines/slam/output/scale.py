"""What makes the map of one camera metric: places, lengths, objects or odometry that are known besides its images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from epipole.config import AnchorOptions
from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.geometry import Rigid3, Similarity3
from epipole.pipelines.slam.map.imu import scale_by_factors
from epipole.pipelines.slam.map.local_mapping import LocalMapper
from epipole.pipelines.slam.output.export import reconstruction_of
from epipole.pipelines.slam.output.map_file import KnownMap
from epipole.pipelines.slam.slam import Slam
from epipole.scale import (
    Anchoring,
    AnchorViews,
    ScaleEstimate,
    after_adjustment,
    anchor_model,
    views_of_model,
)
from epipole.scene import Trajectory


def anchor_map(
    system: Slam, options: AnchorOptions, keyframe_names: Sequence[str], frame_names: Mapping[float, str]
) -> Anchoring:
    """Tell the first map in metres; with measured places in their world, and adjusted with them as factors.

    Args:
        system: of one camera, after its last frame.
        options: what is known.
        keyframe_names: of the first map's keyframes.
        frame_names: of every frame, by its time.

    Raises:
        ConfigError: the camera is metric already.
        DegenerateGeometryError: nothing that is known tells the scale; the message says why.
        FileFormatError: a file that was named cannot be read.
    """
    check_one_camera(options, measures_depth=system.camera.measures_depth)
    model, camera = system.maps[0], system.camera.camera
    keyframes = [k for k in model.keyframes if len(k.point)]
    views = views_of_model(reconstruction_of(model, camera, keyframe_names), lambda row: keyframes[row].grey)
    # What is known is told by the clock and the names of this run: keyframes of a known map have others.
    is_old = np.array([k.number < system.first_number for k in keyframes], bool)
    views = replace(
        views,
        names=tuple("" if old else name for old, name in zip(is_old, views.names)),
        timestamp_s=np.where(is_old, np.nan, views.timestamp_s),
    )
    path = _views_of_path(system.trajectory(), frame_names, views)
    by_imu = scale_by_imu(system)
    if by_imu is not None:
        options = replace(options, imu=None, imu_mounting=None)
    anchoring = anchor_model(views, options, path, [] if by_imu is None else [by_imu])
    model.move(anchoring.world_from_model)
    positions = anchoring.positions
    if positions is not None:
        before = _centers(system)
        mapper = LocalMapper(model, system.camera, system.focal_baseline, system.config, system.imu)
        known = np.isfinite(positions.positions[:, 0])
        mapper.positions = {
            k.number: p for k, p, is_known in zip(keyframes, positions.positions, known) if is_known
        }
        mapper.position_sigma = positions.sigma
        mapper.learn_inertial()
        mapper.adjust_all()
        model.move(after_adjustment(anchoring, before, _centers(system)))
    return anchoring


def scale_by_imu(system: Slam) -> ScaleEstimate | None:
    """By an adjustment with the inertial unit's factors; None where they have none: the path's alignment says why."""
    if system.imu is None:
        return None
    mapper = LocalMapper(system.maps[0], system.camera, system.focal_baseline, system.config, system.imu)
    mapper.learn_inertial()
    adjusted = mapper.adjust_all()
    try:
        return None if adjusted is None else scale_by_factors(*adjusted[:3], system.imu)
    except DegenerateGeometryError:
        return None


def check_one_camera(options: AnchorOptions, *, measures_depth: bool) -> None:
    """Check that there is a scale to be told.

    Raises:
        ConfigError: the camera has its metres from its own depth.
    """
    if measures_depth and not options.is_empty:
        raise ConfigError(
            "positions, lengths, tags, boards and odometry tell the scale of one camera; this one has its metres from its "
            "own depth"
        )


def check_known_map(options: AnchorOptions, known: KnownMap | None, *, is_map_fixed: bool) -> None:
    """Check that the unit of a map that is gone on in may be changed, where something is given that would.

    Raises:
        ConfigError: the map is in metres already, or is to stay as it is.
    """
    if known is None or options.is_empty:
        return
    given = " and ".join(options.given)
    if known.is_metric:
        whence = f" ({known.scale})" if known.scale else ""
        raise ConfigError(
            f"the map is in metres already{whence}: {given} would change its unit. Leave that out, or begin a new map "
            "(without map)"
        )
    if is_map_fixed:
        raise ConfigError(
            f"localize leaves the map as it is, and it is up to scale: {given} would change its unit. Go on in it once "
            "without localize: the map that this writes is in metres"
        )


def _centers(system: Slam) -> np.ndarray:
    return np.stack([k.cam_from_world.centers() for k in system.maps[0].keyframes if len(k.point)])


def _views_of_path(path: Trajectory, names: Mapping[float, str], keyframes: AnchorViews) -> AnchorViews:
    """Every frame that has a place."""
    count, known = len(path), path.covariance
    covariance = np.zeros((count, 6, 6)) if known is None else known
    return AnchorViews(
        tuple(names.get(float(t), "") for t in path.timestamp_s),
        path.timestamp_s,
        path.world_from_body.inverse(),
        keyframes.cameras[:1] * count,
        lambda row: covariance[row],
        lambda _: None,
    )


def moved_path(path: Trajectory, world_from_model: Similarity3) -> Trajectory:
    """A path told in the metres and the world that were found afterwards."""
    positions, scale = path.world_from_body, float(world_from_model.scale)
    moved = Rigid3(
        world_from_model.rotation @ positions.rotation, world_from_model.apply(positions.translation)
    )
    covariance = path.covariance
    if covariance is not None:
        unit = np.array([scale, scale, scale, 1.0, 1.0, 1.0])
        covariance = covariance * unit[:, None] * unit
    return Trajectory(path.timestamp_s, moved, covariance)
