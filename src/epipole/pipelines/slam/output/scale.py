"""Metric scale for the map of one camera, from known positions, lengths, objects, odometry or IMU data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from epipole.config import AnchorOptions
from epipole.errors import ConfigError
from epipole.geometry import Rigid3, Similarity3
from epipole.pipelines.slam.map.slam_map import SlamMap
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
    """Scale the first map to meters; with measured positions, also align it to them and use them as factors.

    Args:
        system: SLAM of one camera, after its last frame.
        options: the measurements.
        keyframe_names: image names of the first map's keyframes.
        frame_names: image name of every frame, by timestamp.

    Raises:
        ConfigError: the camera measures depth, so its map is metric already.
        DegenerateGeometryError: the measurements do not determine the scale; the message says why.
        FileFormatError: a given file cannot be read.
    """
    check_one_camera(options, measures_depth=system.camera.is_metric)
    model, camera = system.maps[0], system.camera.camera
    keyframes = [k for k in model.keyframes if len(k.point)]
    views = views_of_model(reconstruction_of(model, camera, keyframe_names), lambda row: keyframes[row].gray)
    # Measurements refer to the clock and image names of this run, not to those of a known map's keyframes.
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
        mapper = system.local_mapper(model)
        known = np.isfinite(positions.positions[:, 0])
        mapper.positions = {
            k.number: p for k, p, is_known in zip(keyframes, positions.positions, known) if is_known
        }
        mapper.position_sigma = positions.sigma
        mapper.learn_inertial(is_last=True)
        mapper.adjust_all()
        model.move(after_adjustment(anchoring, before, _centers(system)))
    return anchoring


def scale_by_imu(system: Slam) -> ScaleEstimate | None:
    """Scale of the first map from its adjustments with the IMU; None if there was none (`anchor_model` then says why)."""
    found = system.maps[0].by_imu
    if system.imu is None or found is None or not found.is_adjusted:
        return None
    gain, note = system.imu.noise.accel_gain_sigma, "the IMU, adjusted with the images"
    return ScaleEstimate("imu", "the IMU", found.meters_per_unit, found.sigma, gain, note)


def level_map(system: Slam, anchoring: Anchoring | None) -> tuple[Similarity3 | None, list[str]]:
    """Rotate the first map by the IMU's gravity: z up, x along the horizontal part of the first camera's view.

    Args:
        system: SLAM after the last frame.
        anchoring: how the map became metric; measured positions determine the world already.

    Returns:
        the motion of the map (None without an IMU that agrees, or if the world is known), and notes on clock and mounting.
    """
    if system.camera_imu is None:
        return None, []
    found, notes = system.maps[0].by_imu, system.camera_imu.notes()
    if found is None:
        why = system.camera_imu.other_reading
        words = "the IMU does not agree with the trajectory, or there are too few keyframes: it was not used"
        return None, [f"the IMU was not used: {why}" if why else words, *notes]
    if anchoring is not None and anchoring.positions is not None:
        return None, notes
    axes = upright_axes(system.maps[0], found.gravity_in_world)
    leveled = Similarity3(np.array(1.0), axes, np.zeros(3))
    system.maps[0].move(leveled)
    return leveled, notes


def upright_axes(model: SlamMap, gravity: np.ndarray) -> np.ndarray:
    """(3, 3) rotation of a map into a world with z up, in which the first camera looks along x, or if it looks up or down, its upper edge does."""
    cam_from_world = next(k.cam_from_world for k in model.keyframes if len(k.point))
    up = -gravity / np.linalg.norm(gravity)
    view, above = cam_from_world.rotation[2], -cam_from_world.rotation[1]
    ahead = max((view, above), key=lambda axis: float(np.linalg.norm(np.cross(axis, up))))
    left = np.cross(up, ahead)
    left /= np.linalg.norm(left)
    return np.stack([np.cross(left, up), left, up])


def check_one_camera(options: AnchorOptions, *, measures_depth: bool) -> None:
    """Check that options that set the scale are given for one camera only; an IMU does more.

    Raises:
        ConfigError: the camera measures depth, so its map is metric already.
    """
    if measures_depth and set(options.given) - {"imu"}:
        raise ConfigError(
            "positions, lengths, tags, boards and odometry set the scale of one camera, but the map of a stereo or depth"
            " camera is metric already"
        )


def check_known_map(options: AnchorOptions, known: KnownMap | None, *, is_map_fixed: bool) -> None:
    """Check that the scale of a known map may change, if the options would change it.

    Raises:
        ConfigError: the map is metric already, or fixed.
    """
    if known is None or options.is_empty:
        return
    given = " and ".join(options.given)
    if known.is_metric:
        whence = f" ({known.scale})" if known.scale else ""
        raise ConfigError(
            f"the known map is metric already{whence}: {given} would change its scale. Omit that, or start a new map (without"
            " map)"
        )
    if is_map_fixed:
        raise ConfigError(
            f"localize does not change the known map, which is up to scale: {given} would change its scale. Run once without"
            " localize to write a metric map"
        )


def _centers(system: Slam) -> np.ndarray:
    return np.stack([k.cam_from_world.centers() for k in system.maps[0].keyframes if len(k.point)])


def _views_of_path(path: Trajectory, names: Mapping[float, str], keyframes: AnchorViews) -> AnchorViews:
    """All localized frames as views."""
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
    """Transform a trajectory and its covariances into the metric world."""
    positions, scale = path.world_from_body, float(world_from_model.scale)
    moved = Rigid3(
        world_from_model.rotation @ positions.rotation, world_from_model.apply(positions.translation)
    )
    covariance = path.covariance
    if covariance is not None:
        unit = np.array([scale, scale, scale, 1.0, 1.0, 1.0])
        covariance = covariance * unit[:, None] * unit
    return Trajectory(path.timestamp_s, moved, covariance)
