"""Bundle adjustment of an existing model, such as one from a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from epipole._checks import checked
from epipole.geometry import Rigid3
from epipole.mapping.adjustment import Freedom, free_params_of
from epipole.optim import (
    BundleConfig,
    BundleIteration,
    BundlePriors,
    BundleProblem,
    BundleResult,
    adjust_bundle,
)
from epipole.scene import Reconstruction


@checked
def bundle_problem_of(
    model: Reconstruction, freedom: Freedom | None = None, priors: BundlePriors | None = None
) -> BundleProblem:
    """A model as a bundle problem: frames and points are free, intrinsics as specified, rigs fixed.

    Args:
        model: poses, cameras, points and tracks; tracks must not include unregistered images.
        freedom: intrinsics to adjust, for cameras that are not constant; None: focal length and distortion.
        priors: further knowledge; rows are those of the model's frames, cameras and points.
    """
    image = model.tracks.image
    positions = model.frames.rig_from_world
    return BundleProblem(
        rig_from_world=positions.or_identity(),
        cam_from_rig=model.rigs.cam_from_rig,
        camera_model=model.cameras.model,
        camera_params=model.cameras.params,
        points_in_world=model.points.xyz_in_world,
        offsets=model.tracks.offsets,
        frame=model.images.frame[image],
        sensor=model.images.sensor[image],
        camera=model.camera_of_image[image],
        pixels=model.observed_pixels(),
        frame_free=np.ones((len(model.frames), 6)),
        params_free=free_params_of(model.cameras, freedom or Freedom()),
        point_free=np.ones(len(model.points)),
        priors=priors,
    )


@checked
def adjust_reconstruction(
    model: Reconstruction,
    config: BundleConfig | None = None,
    freedom: Freedom | None = None,
    priors: BundlePriors | None = None,
    progress: Callable[[BundleIteration], bool] | None = None,
) -> tuple[Reconstruction, BundleResult]:
    """Adjust a model; returns a new model and the adjustment's result.

    Position, orientation and scale are free unless priors fix them: align the model afterwards if they matter.
    """
    problem = bundle_problem_of(model, freedom, priors)
    result = adjust_bundle(problem, config, progress)
    return with_adjustment(model, result), result


@checked
def with_adjustment(model: Reconstruction, result: BundleResult) -> Reconstruction:
    """The model with adjusted intrinsics, rigs, poses and points, and their mean reprojection errors.

    Args:
        model: the model that was adjusted.
        result: the adjustment; it may have further points after those of the model.
    """
    registered = model.frames.is_registered()
    before, after = model.frames.rig_from_world, result.rig_from_world
    moved = Rigid3(
        np.where(registered[:, None, None], after.rotation, before.rotation),
        np.where(registered[:, None], after.translation, before.translation),
    )
    adjusted = replace(
        model,
        cameras=replace(model.cameras, params=result.camera_params),
        rigs=replace(model.rigs, cam_from_rig=result.cam_from_rig),
        frames=replace(model.frames, rig_from_world=moved),
        points=replace(model.points, xyz_in_world=result.points_in_world[: len(model.points)]),
    )
    errors, counts = np.nan_to_num(adjusted.reprojection_errors_px()), np.diff(model.tracks.offsets)
    sums = np.bincount(model.tracks.point_of_observation(), errors, minlength=len(counts))
    error_px = np.divide(sums, counts, out=np.zeros(len(counts)), where=counts > 0)
    return replace(adjusted, points=replace(adjusted.points, error_px=error_px))
