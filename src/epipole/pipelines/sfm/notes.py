"""What is said of a finished run: notes and warnings in plain words, and the name of what was reconstructed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from epipole.io.video import is_video
from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.mapping_stage import gps_note
from epipole.pipelines.sfm.pipeline import Solution

KINDS_OF_FOLDER = frozenset(
    {"color", "colour", "data", "frames", "image", "images", "img", "imgs", "input"}
    | {"photo", "photographs", "photos", "pictures", "rgb"}
)
"""Names of folders that tell nothing of what the pictures show."""


def title_of(source: Path) -> str:
    """What a run is called: its video, or its folder, or the one above where that is called `images`."""
    source = source.resolve()
    if is_video(source):
        return source.stem
    while source.name.lower() in KINDS_OF_FOLDER and source.parent.name:
        source = source.parent
    return source.name or str(source)


def notes_on_choice_and_lenses(solution: Solution) -> list[str]:
    """What was noticed about pictures and masks, and focal lengths that nobody gave."""
    return [*solution.images.notes, *_focal_notes(solution)]


def warnings_of(solution: Solution, config: MapperConfig) -> list[str]:
    """What may be wrong with the models."""
    out, mapped = [], solution.mapped
    for number, agreement in enumerate(mapped.agreements):
        if agreement < config.min_final_agreement:
            out.append(
                f"model {number} agrees with only {100 * agreement:.0f} % of its own matches: "
                "parts of it are probably wrong (a wrong focal length, or things that look alike)"
            )
    if note := gps_note(solution.images, mapped, config):
        out.append(note)
    return out


def absences_of(solution: Solution, reasons: Mapping[str, str]) -> list[str]:
    """Pictures and models that are apart; the report says the same in its own words."""
    out, mapped, images = [], solution.mapped, solution.images
    if reasons:
        out.append(f"{len(reasons)} of {len(images) + len(images.left_out)} pictures are in no model")
    if len(mapped.models) > 1:
        counts = ", ".join(str(int(m.is_registered().sum())) for m in mapped.models)
        out.append(
            f"the pictures fall into {len(mapped.models)} models that do not connect ({counts} pictures)"
        )
    return out


def _focal_notes(solution: Solution) -> list[str]:
    """Of each camera whose focal length came out of the pictures: the guess, and what the model made of it."""
    out = []
    for c in solution.guessed_cameras:
        guess_px = solution.cameras[c].focal_px
        taken = [m for m in solution.mapped.models if (m.is_registered() & (m.camera_of_image == c)).any()]
        final = f"{taken[0].cameras[c].focal_px:.0f} px in the model" if taken else "none of them has a place"
        out.append(
            f"focal length of {pictures_of_camera(solution, c)}: {guess_px:.0f} px estimated from the pictures "
            f"themselves, {final}"
        )
    return out


def pictures_of_camera(solution: Solution, camera: int) -> str:
    """The pictures that a camera took: the first one, and how many more."""
    rows = np.flatnonzero(solution.images.camera_of_image == camera)
    if not len(rows):
        return "no picture"
    first, others = solution.images.names[rows[0]], len(rows) - 1
    return first if not others else f"{first} and {others} other{'s' if others > 1 else ''}"
