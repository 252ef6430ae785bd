"""A model with rigs: frames instead of independent images, adjusted with fixed or constant geometry.

Images are mapped one by one. Then the frames of each rig get one pose, the geometry of the rig is the given one or the mean of the relative
poses, and everything is adjusted together. Known geometry gives meters: the median ratio of its distances to those in the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from epipole.cameras import CameraModel
from epipole.geometry import Rigid3, Rotation3, Similarity3
from epipole.mapping import Freedom, bundle_problem_of, with_adjustment
from epipole.optim import BundlePriors, BundleProblem, BundleResult, adjust_bundle, bundle_covariance
from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.mappers.incremental import final_bundle
from epipole.pipelines.sfm.rigs.assignment import RigAssignment
from epipole.pipelines.sfm.rigs.geometry import (
    contradiction_of,
    inconstancy_of,
    relative_poses,
    robust_mean,
    rotation_angles_rad,
)
from epipole.pipelines.sfm.rigs.lengths import (
    CALIBRATION_SIGMA,
    contradiction_of_scales,
    contradictory_lengths,
    length_ratios,
    scale_of_lengths,
)
from epipole.scale import ScaleEstimate
from epipole.scene import Frames, Reconstruction, Rigs, unregistered
from epipole.scene.point_accuracy import pixel_noise

OUTLIER_RAD = np.deg2rad(5.0)
"""Rotation from the median pose of its frame above which an image does not determine the frame's pose."""
LEAST_NOISE_PX = 0.05
PRINCIPAL_SIGMA_PX = 0.5
"""Standard deviation of the principal points of cameras with known geometry, relative to the reference."""
NOTABLE_PX, IMPLAUSIBLE_PX = 0.1, 2.0
"""Corrections of a principal point that are reported, and that a calibration hardly needs."""
GEOMETRY_MAY_BE_WRONG = (
    "; so much is rather an error of the given geometry: check its rotations and distances"
)


@dataclass(frozen=True, slots=True, eq=False)
class RigModel:
    """A model with rigs."""

    model: Reconstruction
    scale: ScaleEstimate | None
    """If the known geometry of a rig makes the model metric."""
    geometry: dict[str, dict[str, Any]]
    """By prefix or pattern of each sensor: its pose in the rig and, if estimated, the standard deviations of position and rotation."""
    notes: tuple[str, ...]


def with_rigs(
    model: Reconstruction,
    assignment: RigAssignment,
    config: MapperConfig,
    metric: ScaleEstimate | None = None,
) -> RigModel:
    """Replace the independent images of rigs by frames, and adjust; sensors that contradict the images stay independent.

    Args:
        model: a model of single images, in the order of the assignment.
        assignment: rig, sensor and frame of each image.
        config: options of the last adjustment.
        metric: scale of a model that is in meters already; rigs that contradict it are not used.
    """
    usable, notes = _usable_sensors(model, assignment)
    notes = assignment.notes_on_names(model.images.name) + notes
    ratios = _length_ratios(model, assignment, usable)
    wrong = contradictory_lengths(ratios)
    notes += [_not_used(assignment, s, why) for s, why in wrong.items()]
    usable -= {*wrong}
    scaled = scale_of_lengths({s: own for s, own in ratios.items() if s in usable})
    if scaled is not None and metric is not None and (why := contradiction_of_scales(scaled, metric)):
        return RigModel(model, None, {}, (*notes, why))
    if scaled is not None:
        model = _scaled(model, scaled.factor)
    geometry = _geometry(model, assignment, usable)
    if not any(len(own) > 1 for own in _sensors_by_rig(assignment, geometry).values()):
        return RigModel(model, None, {}, tuple(notes))
    rigged, row_of, num_further = _with_frames(model, assignment, geometry)
    if num_further:
        notes.append(f"{num_further} images get their pose from the other cameras of their rig")
    free = [row for s, row in row_of.items() if not _is_given(assignment, s)]
    given = [
        row for s, row in row_of.items() if _is_given(assignment, s) and not _is_reference(assignment, s)
    ]
    adjusted, problem, result = _adjusted(rigged, free, given, config, is_metric=scaled is not None)
    notes += _principal_notes(rigged, adjusted, given)
    sigmas, relative_sigma = _accuracy(adjusted, problem, result, config, free)
    scale = None
    if scaled is not None:
        words = f"known geometry of rigs in {scaled.num_frames} frames"
        total_sigma = float(np.hypot(relative_sigma, CALIBRATION_SIGMA))
        scale = ScaleEstimate("rig", words, 1.0, total_sigma, 0.0, words)
    entries = {
        assignment.sensors[s].images.text: {
            **_entry(adjusted.rigs.cam_from_rig[row], sigmas.get(row)),
            "is_reference": _is_reference(assignment, s),
        }
        for s, row in row_of.items()
    }
    return RigModel(adjusted, scale, entries, tuple(notes))


def _entry(cam_from_rig: Rigid3, sigma: tuple[float, float] | None) -> dict[str, Any]:
    out: dict[str, Any] = {
        "cam_from_rig_rotation": Rotation3(cam_from_rig.rotation).as_quat_wxyz().tolist(),
        "cam_from_rig_translation": cam_from_rig.translation.tolist(),
        "is_given": sigma is None,
    }
    if sigma is not None:
        out |= {"position_sigma": sigma[0], "rotation_sigma_deg": sigma[1]}
    return out


def _usable_sensors(model: Reconstruction, assignment: RigAssignment) -> tuple[set[int], list[str]]:
    """Sensors whose images agree with a rigid rig and with its given geometry, and why others do not."""
    cams, out, notes = model.cams_from_world(), set[int](), list[str]()
    centers = model.camera_centers_in_world()
    extent = float(np.linalg.norm(np.nanmax(centers, axis=0) - np.nanmin(centers, axis=0)))
    for s, sensor in enumerate(assignment.sensors):
        why = _several_cameras(model, assignment, s)
        if not why and not _is_reference(assignment, s):
            found, given = relative_poses(cams, assignment, s), sensor.cam_from_rig
            why = inconstancy_of(found, extent) if given is None else contradiction_of(found, given)
            if given is not None and not len(found):
                why = "no frame has it and the reference registered"
        if why:
            notes.append(_not_used(assignment, s, why))
        else:
            out.add(s)
    without_reference = {s for s in out if assignment.reference_of(s) not in out}
    return out - without_reference, notes


def _several_cameras(model: Reconstruction, assignment: RigAssignment, sensor: int) -> str:
    """Why the images of a sensor are not those of one camera; empty if they are."""
    rows = np.unique(model.camera_of_image[assignment.sensor == sensor]).tolist()
    if len(rows) == 1:
        return ""
    cameras = [model.cameras[c] for c in rows[:2]]
    words = " and ".join(f"{c.width}x{c.height} with a focal length of {c.focal_px:.0f} px" for c in cameras)
    return f"they are of {len(rows)} cameras ({words})"


def _not_used(assignment: RigAssignment, sensor: int, why: str) -> str:
    return f"the rig is not used for the images with the {assignment.sensors[sensor].images.in_words}: {why}"


def _length_ratios(
    model: Reconstruction, assignment: RigAssignment, usable: set[int]
) -> dict[int, np.ndarray]:
    """Of each sensor with known geometry: its known distance from the reference over that in the model."""
    cams, out = model.cams_from_world(), dict[int, np.ndarray]()
    for s in sorted(usable):
        given = assignment.sensors[s].cam_from_rig
        if given is not None and not _is_reference(assignment, s):
            known = float(np.linalg.norm(given.translation))
            out[s] = length_ratios(relative_poses(cams, assignment, s), known)
    return out


def _scaled(model: Reconstruction, factor: float) -> Reconstruction:
    """Scale about the middle of the cameras, so that a model with a position on Earth keeps it."""
    middle = np.nanmean(model.camera_centers_in_world(), axis=0)
    larger = Similarity3(np.asarray(factor), np.eye(3), middle - factor * middle)
    return replace(model.transformed(larger), georeference=model.georeference)


def _is_reference(assignment: RigAssignment, sensor: int) -> bool:
    return sensor == assignment.reference_of(sensor)


def _is_given(assignment: RigAssignment, sensor: int) -> bool:
    return assignment.sensors[sensor].cam_from_rig is not None


def _geometry(model: Reconstruction, assignment: RigAssignment, usable: set[int]) -> dict[int, Rigid3]:
    """cam_from_rig of each usable sensor: the given one, or the mean of the relative poses."""
    cams, out = model.cams_from_world(), dict[int, Rigid3]()
    for s in sorted(usable):
        given = assignment.sensors[s].cam_from_rig
        out[s] = (
            robust_mean(relative_poses(cams, assignment, s).cam_from_reference) if given is None else given
        )
    return out


def _sensors_by_rig(assignment: RigAssignment, geometry: dict[int, Rigid3]) -> dict[int, list[int]]:
    out: dict[int, list[int]] = {}
    for s in geometry:
        out.setdefault(int(assignment.rig_of_sensor[s]), []).append(s)
    return out


def _with_frames(
    model: Reconstruction, assignment: RigAssignment, geometry: dict[int, Rigid3]
) -> tuple[Reconstruction, dict[int, int], int]:
    """The model with rigs of several sensors; also the row of each sensor, and the number of images that get their pose from their frame."""
    by_rig = [own for own in _sensors_by_rig(assignment, geometry).values() if len(own) > 1]
    in_rig = {s: (r, n) for r, own in enumerate(by_rig) for n, s in enumerate(own)}
    camera = model.camera_of_image
    sensor_camera, poses, offsets = list[int](), list[Rigid3](), [0]
    for own in by_rig:
        for s in own:
            sensor_camera.append(int(camera[np.flatnonzero(assignment.sensor == s)[0]]))
            poses.append(geometry[s])
        offsets.append(len(sensor_camera))
    others = [k for k, s in enumerate(assignment.sensor.tolist()) if s not in in_rig]
    single_of = {c: len(sensor_camera) + n for n, c in enumerate(np.unique(camera[others]).tolist())}
    for c in single_of:  # a rig of one sensor for the cameras of other images
        sensor_camera.append(c)
        poses.append(Rigid3.identity())
        offsets.append(len(sensor_camera))
    start, start_of_singles = [offsets[r] for r in range(len(by_rig))], offsets[len(by_rig)]
    sensor, frame_key = np.empty(len(camera), np.int32), list[tuple[int, int]]()
    for k in range(len(camera)):
        s = int(assignment.sensor[k])
        if s in in_rig:
            r, n = in_rig[s]
            sensor[k] = start[r] + n
            frame_key.append((r, int(assignment.frame[k])))
        else:
            sensor[k] = single_of[int(camera[k])]
            frame_key.append((len(by_rig) + int(sensor[k]) - start_of_singles, -1 - k))
    keys = {key: f for f, key in enumerate(dict.fromkeys(frame_key))}
    frame = np.array([keys[key] for key in frame_key], np.int32)
    rigs = Rigs(
        np.array(offsets, np.int32),
        np.array(sensor_camera, np.int32),
        Rigid3(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses])),
    )
    rig_from_world, num_further = _frame_poses(model, rigs, sensor, frame, len(keys))
    times = np.full(len(keys), np.nan)
    times[frame] = model.frames.timestamp_s[model.images.frame]
    frames = Frames(np.array([r for r, _ in keys], np.int32), rig_from_world, times)
    images = replace(model.images, frame=frame, sensor=sensor)
    rows = {s: start[r] + n for s, (r, n) in in_rig.items()}
    return replace(model, rigs=rigs, frames=frames, images=images), rows, num_further


def _frame_poses(
    model: Reconstruction, rigs: Rigs, sensor: np.ndarray, frame: np.ndarray, count: int
) -> tuple[Rigid3, int]:
    """rig_from_world of each frame, from its images that agree, and the number of images without a pose of their own."""
    own = rigs.cam_from_rig[sensor].inverse() @ model.cams_from_world()
    known = np.isfinite(own.translation).all(axis=1)
    out, num_further = unregistered(count), 0
    num_observations = np.bincount(model.tracks.image, minlength=len(model.images))
    order = np.argsort(frame, kind="stable")
    bounds = np.searchsorted(frame[order], np.arange(count + 1))
    for f in range(count):
        rows = order[bounds[f] : bounds[f + 1]]
        rows_known = rows[known[rows]]
        if not len(rows_known):
            continue
        center = np.median(own[rows_known].centers(), axis=0)
        spread = [
            float(rotation_angles_rad(own.rotation[rows_known], own.rotation[k]).sum()) for k in rows_known
        ]
        # Of two images that contradict each other, the one with more observations.
        best = int(rows_known[np.lexsort((-num_observations[rows_known], np.round(spread, 6)))[0]])
        near = rows_known[rotation_angles_rad(own.rotation[rows_known], own.rotation[best]) <= OUTLIER_RAD]
        mean = robust_mean(own[near])
        out.rotation[f] = mean.rotation
        at = center if len(near) == len(rows_known) else np.median(own[near].centers(), axis=0)
        out.translation[f] = -mean.rotation @ at
        num_further += len(rows) - len(rows_known)
    return out, num_further


def _adjusted(
    model: Reconstruction,
    free: Sequence[int],
    given: Sequence[int],
    config: MapperConfig,
    *,
    is_metric: bool,
) -> tuple[Reconstruction, BundleProblem, BundleResult]:
    """Adjust poses of frames, estimated geometry, intrinsics and points; known geometry fixes the scale.

    The principal points of cameras with known geometry may move by fractions of a pixel: a calibration that is off by 0.2 px changes the
    scale of a narrow stereo pair by half a percent, which the standard deviation then includes.

    Args:
        model: the model with rigs.
        free: sensors with estimated geometry.
        given: sensors with known geometry, other than references.
        config: options of the adjustment.
        is_metric: whether known distances between cameras determine the scale.
    """
    freedom = Freedom(focal=config.refine_focal, distortion=config.refine_distortion)
    problem = bundle_problem_of(model, freedom)
    sensor_free = np.zeros((len(model.rigs.sensor_camera), 6))
    sensor_free[list(free)] = 1.0
    params_free, sigma = problem.params_free.copy(), np.full(problem.params_free.shape, np.inf)
    noise_px = max(pixel_noise(model), LEAST_NOISE_PX)
    for camera in np.unique(model.rigs.sensor_camera[list(given)]).tolist():
        at = list(CameraModel(int(model.cameras.model[camera])).principal_point_indices)
        params_free[camera, at], sigma[camera, at] = 1.0, PRINCIPAL_SIGMA_PX / noise_px
    problem = replace(
        problem,
        sensor_free=sensor_free,
        params_free=params_free,
        priors=BundlePriors(params_expected=problem.camera_params.copy(), params_sigma=sigma),
    )
    problem = _with_fixed_start(problem, is_metric=is_metric)
    result = adjust_bundle(problem, final_bundle(config, float(np.nanmedian(model.reprojection_errors_px()))))
    return with_adjustment(model, result), problem, result


def _principal_notes(before: Reconstruction, after: Reconstruction, given: Sequence[int]) -> list[str]:
    """Notes on principal points that the images contradict."""
    out = []
    for row in given:
        camera = int(before.rigs.sensor_camera[row])
        at = list(CameraModel(int(before.cameras.model[camera])).principal_point_indices)
        off_px = after.cameras.params[camera, at] - before.cameras.params[camera, at]
        if np.abs(off_px).max() > NOTABLE_PX:
            name = before.images.name[int(np.flatnonzero(before.images.sensor == row)[0])]
            out.append(
                f"the images contradict the calibration of the camera of {name}: its principal point is {off_px[0]:+.2f}, {off_px[1]:+.2f} px "
                "off relative to that of the reference, and was corrected"
                + (GEOMETRY_MAY_BE_WRONG if np.abs(off_px).max() > IMPLAUSIBLE_PX else "")
            )
    return out


def _with_fixed_start(problem: BundleProblem, *, is_metric: bool) -> BundleProblem:
    """Fix the frame with most observations and, unless known geometry gives the scale, one coordinate of the farthest frame."""
    free = problem.frame_free.copy()
    counts = np.bincount(problem.frame, minlength=len(free))
    first = int(np.argmax(counts))
    free[first] = 0.0
    if not is_metric:
        centers = problem.rig_from_world.centers()
        distance = np.where(counts > 0, np.linalg.norm(centers - centers[first], axis=1), 0.0)
        second = int(np.argmax(np.nan_to_num(distance)))
        along = problem.rig_from_world.rotation[second] @ (centers[second] - centers[first])
        free[second, np.argmax(np.abs(along))] = 0.0
    return replace(problem, frame_free=free)


def _accuracy(
    model: Reconstruction,
    problem: BundleProblem,
    result: BundleResult,
    config: MapperConfig,
    free: Sequence[int],
) -> tuple[dict[int, tuple[float, float]], float]:
    """Standard deviations of estimated geometry by row, in model units and degrees, and the relative one of the largest distance."""
    noise_px = max(pixel_noise(model), LEAST_NOISE_PX)
    bundle = final_bundle(config, float(np.nanmedian(model.reprojection_errors_px())))
    found = bundle_covariance(problem, result, bundle, noise_px=noise_px, clustered=True)
    sigmas = {}
    for row in free:
        position, rotation = (
            _largest_sigma(found.cam_from_rig[row, at, at]) for at in (slice(0, 3), slice(3, 6))
        )
        sigmas[row] = (position, float(np.degrees(rotation)))
    # The first frame is fixed; a center c moves by -R^T rho under exp(rho, phi) @ rig_from_world.
    first = int(np.flatnonzero(~problem.frame_free.any(axis=1))[0])
    poses = result.rig_from_world
    is_observed = np.bincount(problem.frame, minlength=len(problem.frame_free)) > 0
    offset = poses.centers() - poses[first].centers()
    length = np.where(is_observed, np.linalg.norm(offset, axis=1), 0.0)
    far = int(np.argmax(length))
    if not length[far] > 0 or not np.isfinite(found.rig_from_world[far]).all():
        return sigmas, 0.0  # one frame: its lengths are as precise as the given geometry
    direction = poses.rotation[far] @ (offset[far] / length[far])
    variance = float(direction @ found.rig_from_world[far, :3, :3] @ direction)
    return sigmas, float(np.sqrt(variance) / length[far])


def _largest_sigma(covariance: np.ndarray) -> float:
    """Standard deviation in the least certain direction; infinite if undetermined."""
    return (
        float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])) if np.isfinite(covariance).all() else float("inf")
    )
