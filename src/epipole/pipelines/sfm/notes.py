"""Notes and warnings about a finished run, and its title."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from epipole.image.pixels_without_ray import no_ray_warning
from epipole.io.images.video import is_video
from epipole.mapping.focal_accuracy import FocalAccuracy
from epipole.pipelines.sfm.anchored import UP_TO_SCALE
from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.gps.gps_notes import gps_notes
from epipole.pipelines.sfm.known_poses import notes_on_poses
from epipole.pipelines.sfm.mapping_stage import images_left
from epipole.pipelines.sfm.pipeline import FOCAL_CORRECTION, Solution

KINDS_OF_FOLDER = frozenset(
    {"color", "colour", "data", "frames", "image", "images", "img", "imgs", "input"}
    | {"photo", "photographs", "photos", "picture", "pictures", "rgb"}
)
"""Folder names that do not describe the content."""
CAMERAS_SHOWN = 3
LEAST_LEFT = 3
"""Images that match each other and are in no model, from which there is a warning."""


def title_of(source: Path) -> str:
    """Title of a run: name of its video or folder, skipping generic folders such as `images`."""
    source = source.resolve()
    if is_video(source):
        return source.stem
    while source.name.lower() in KINDS_OF_FOLDER and source.parent.name:
        source = source.parent
    return source.name or str(source)


def notes_on_choice_and_cameras(solution: Solution) -> list[str]:
    """Notes on the choice of images and masks, and on focal lengths that were not given."""
    return [*solution.images.notes, *_focal_notes(solution), *_rescue_notes(solution)]


def _rescue_notes(solution: Solution) -> list[str]:
    """What learned features were used for."""
    found, models = solution.rescue, solution.mapped.models
    if not found.images or not models:
        return []
    count = int(np.any([model.is_registered() for model in models], axis=0)[list(found.images)].sum())
    return [
        f"{len(found.images)} images that SIFT connects to few others: learned features verify or improve {found.num_pairs}"
        f" pairs, and {count} of these images are registered"
    ]


def warnings_of(solution: Solution, config: MapperConfig) -> list[str]:
    """Warnings about the models."""
    out, mapped = [], solution.mapped
    for number, agreement in enumerate(mapped.agreements):
        if agreement < config.min_final_agreement:
            out.append(
                f"model {number} agrees with only {100 * agreement:.0f} % of its matches: "
                "parts of it are probably wrong (a wrong focal length, or similar-looking structures)"
            )
    out += [*mapped.notes, *_unmapped_warnings(solution, config)]
    out += _look_alike_warnings(solution)
    for number, model in enumerate(mapped.models):
        used = np.unique(model.camera_of_image[model.is_registered()])
        cameras = [(int(c), model.cameras[int(c)]) for c in used]
        out += [f"model {number}, camera {c}: {words}" for c, one in cameras for words in no_ray_warning(one)]
    images = solution.images
    out += notes_on_poses(
        images.names, images.known_poses, mapped.pose_fits[0], mapped.models[0].is_registered()
    )
    out += gps_notes(images, mapped, config)
    return [*out, *_shape_warnings(solution), *_wrong_focals(solution)]


def _unmapped_warnings(solution: Solution, config: MapperConfig) -> list[str]:
    """A warning if mapping ended at the largest number of models, although other images match each other."""
    models = solution.mapped.models
    if len(models) < config.max_models:
        return []
    num_images = len(models[0].is_registered())
    count = int(images_left(num_images, solution.mapped, solution.view_graph, config).sum())
    if count < LEAST_LEFT:
        return []
    return [
        f"mapping ended after {len(models)} models, but {count} of the other images match each other: raise --mapper.max-models to map"
        " them, too"
    ]


def _look_alike_warnings(solution: Solution) -> list[str]:
    """Warnings about different things that look alike: pairs that were left out, and models that may show them as one."""
    out = []
    if (count := int(solution.contradicting.is_conflicting.sum())) > 0:
        num_models = len(solution.mapped.models)
        result = (
            f"the images are mapped to {num_models} models, whose positions relative to each other are unknown; one of"
            " them may still show different things as one: check them"
            if num_models > 1
            else "without them no points conflict, but the model may still show different things as one: check it"
            if not any(found.contradicts_model for found in solution.conflicts)
            else "the others conflict, too"
        )
        out.append(
            f"different things look alike: {count} pairs of images whose points conflict are not used; {result} (report, table of"
            " pairs; --mapper.no-separate-look-alikes uses them)"
        )
    out += [
        f"model {number}: in {int(found.is_contradiction.sum())} of {int(found.is_judged.sum())} verified pairs with similar"
        " views, points conflict: it probably shows different things that look alike as one; map them apart (--exclude), or"
        " match only neighboring images (--pairs, --pairing.method sequential)"
        for number, found in enumerate(solution.conflicts)
        if found.contradicts_model
    ]
    return out


def _wrong_focals(solution: Solution) -> list[str]:
    """Warnings about known focal lengths that the images contradict."""
    known = solution.images.cameras.is_constant
    wrong = [
        f"{images_of_camera(solution, c)}: {focal.model_px:.0f} px is given, {_with_sigma(focal.focal_px, focal)} estimated"
        for c, focal in solution.focals.items()
        if known[c] and focal.contradicts_model
    ]
    if not wrong:
        return []
    return [
        f"the images contradict the known focal length ({_first_of(wrong)}): if it is wrong, the models are distorted; check the"
        " image size of the calibration, or leave it out"
    ]


def absences_of(solution: Solution, reasons: Mapping[str, str]) -> list[str]:
    """Images in no model, and models that do not connect; the report has its own text for these."""
    out, mapped, images = [], solution.mapped, solution.images
    if reasons:
        of_all = f"{len(reasons)} of {len(images) + len(images.left_out)} images"
        out.append(f"{of_all} {'is' if len(reasons) == 1 else 'are'} in no model")
    if len(mapped.models) > 1:
        counts = ", ".join(str(int(m.is_registered().sum())) for m in mapped.models)
        out.append(f"the images fall into {len(mapped.models)} models that do not connect ({counts} images)")
    return out


def _focal_notes(solution: Solution) -> list[str]:
    """Notes on focal lengths that were not given: estimated ones, guesses, and those that the images do not determine."""
    found, guessed = [], []
    for c in np.flatnonzero(
        ~(solution.images.cameras.is_focal_trusted | solution.images.cameras.is_constant)
    ):
        final_px = _final_focal_px(solution, int(c))
        if final_px is None:
            continue
        of_images, first_px = images_of_camera(solution, int(c)), solution.cameras[int(c)].focal_px
        final = _with_sigma(final_px, solution.focals.get(int(c)))
        if int(c) in solution.guessed_cameras:
            first = f" (first estimate {first_px:.0f} px)" if f"{first_px:.0f}" != f"{final_px:.0f}" else ""
            found.append(f"{of_images}: {final}{first}")
        else:
            guessed.append(f"{of_images}: {final} from a guess of {first_px:.0f} px")
    notes = []
    if found:
        words = "focal length" if len(found) == 1 else "focal lengths"
        notes.append(f"{words} estimated from the images: {_first_of(found)}")
    if guessed:
        notes.append(f"pairs of images do not agree on a focal length: {_first_of(guessed)}")
    return notes


def undetermined_focals(solution: Solution) -> list[int]:
    """Cameras whose focal length is neither given nor determined by the images, so that the model's shape may be wrong.

    A focal length from EXIF counts as given as long as mapping left it nearly unchanged. A camera with too few observations
    to know is not determined.
    """
    cameras, out = solution.images.cameras, []
    for c in np.flatnonzero(~cameras.is_constant).tolist():
        final_px, accuracy = _final_focal_px(solution, c), solution.focals.get(c)
        if final_px is None:
            continue
        change = abs(np.log(final_px / cameras[c].focal_px))
        is_given = cameras.is_focal_trusted[c] and change < FOCAL_CORRECTION
        if not is_given and (accuracy is None or not accuracy.is_determined):
            out.append(c)
    return out


def _shape_warnings(solution: Solution) -> list[str]:
    """Warning about focal lengths that nothing determines."""
    doubtful = undetermined_focals(solution)
    if not doubtful:
        return []
    sigmas = [f"{images_of_camera(solution, c)}: {_fraction_of(solution.focals.get(c))}" for c in doubtful]
    used = [c for c in range(len(solution.images.cameras)) if _final_focal_px(solution, c) is not None]
    of_all = "the focal length" if len(used) == 1 else f"{len(doubtful)} of {len(used)} focal lengths"
    return [
        f"the images do not determine {of_all} (standard deviation: {_first_of(sigmas)}), so the shape of the model may be wrong"
        " by as much: give known values with --calibration or --camera-params, or add images of things at different depths"
    ]


def scale_in_words(solution: Solution) -> str:
    """The source of the scale and its uncertainty, and of what it is the scale."""
    scale = solution.mapped.scale
    if scale is None:
        return UP_TO_SCALE
    words = scale.in_words()
    if undetermined_focals(solution):
        words += ", for distances between cameras; shapes and depths also depend on the focal length, which is not determined"
    return words


def rig_in_words(entry: Mapping[str, Any]) -> str:
    """Position of a camera in its rig, and how precisely it is known (`RigModel.geometry`)."""
    if entry["is_reference"]:
        return "reference"
    translation = ", ".join(f"{value:.4g}" for value in entry["cam_from_rig_translation"])
    words = f"translation in the rig {translation}"
    if entry["is_given"]:
        return f"{words}, as given"
    return f"{words}, estimated to {entry['position_sigma']:.2g}; rotation estimated to {entry['rotation_sigma_deg']:.2g} degrees (1 sigma)"


def focal_source(solution: Solution, camera: int) -> str:
    """Source of a camera's focal length, in words."""
    source = solution.images.focal_sources[camera]
    if solution.images.cameras.is_constant[camera]:
        return source
    if camera in solution.guessed_cameras:
        return f"estimated from the images ({source} at first)"
    return f"{source}, then refined with the model"


def _with_sigma(focal_px: float, accuracy: FocalAccuracy | None) -> str:
    """A focal length and its standard deviation, if known."""
    if accuracy is None or not np.isfinite(accuracy.sigma_px):
        return f"{focal_px:.0f} px"
    return f"{focal_px:.0f} px +- {accuracy.sigma_px:.0f} px"


def focal_verdict(accuracy: FocalAccuracy) -> str:
    """Whether the images determine a focal length, in words."""
    verdict = "determined" if accuracy.is_determined else "not determined"
    return f"{verdict} by the images, {_with_sigma(accuracy.focal_px, accuracy)}"


def _fraction_of(accuracy: FocalAccuracy | None) -> str:
    if accuracy is None or not accuracy.sigma_px < accuracy.focal_px:
        return "100 % or more"
    return f"{100 * accuracy.sigma_px / accuracy.focal_px:.1f} %"


def _final_focal_px(solution: Solution, camera: int) -> float | None:
    """Focal length in the largest model with an image of the camera; None if there is no such model."""
    for model in solution.mapped.models:
        if (model.is_registered() & (model.camera_of_image == camera)).any():
            return float(model.cameras[camera].focal_px)
    return None


def _first_of(cameras: list[str]) -> str:
    more = len(cameras) - CAMERAS_SHOWN
    return "; ".join(cameras[:CAMERAS_SHOWN]) + (f"; and {more} more, see the report" if more > 0 else "")


def images_of_camera(solution: Solution, camera: int) -> str:
    """The first image of a camera, and how many more it has."""
    rows = np.flatnonzero(solution.images.camera_of_image == camera)
    if not len(rows):
        return "no image"
    first, others = solution.images.names[rows[0]], len(rows) - 1
    return first if not others else f"{first} and {others} other{'s' if others > 1 else ''}"
