"""`epipole stereo` and `epipole stereo-doctor`."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import tyro

from epipole.errors import ConfigError, NoModelError
from epipole.pipelines.stereo.config import ModelPair, RigOptions, StereoConfig

Left = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LEFT")]
Right = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RIGHT")]
_NEEDED = "(required, except with --workspace)"
MoreRight = Annotated[
    Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="RIGHT", help_behavior_hint=_NEEDED)
]
MoreOut = Annotated[
    Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="OUT", help_behavior_hint=_NEEDED)
]

DEFAULTS = StereoConfig()
NO_RIG, NO_MODEL = RigOptions(), ModelPair()


def stereo(
    left: Left,
    right: MoreRight = None,
    out: MoreOut = None,
    config: Annotated[StereoConfig, tyro.conf.arg(name="")] = DEFAULTS,
    rig: Annotated[RigOptions, tyro.conf.arg(name="")] = NO_RIG,
    model: Annotated[ModelPair, tyro.conf.arg(name="")] = NO_MODEL,
    strict: bool = False,
) -> None:
    """Compute disparity and depth of a pair of images. Each value has a standard deviation; depth needs known cameras.

    LEFT and RIGHT are two images, two folders, or two videos (the same one twice if it has both images
    side by side). Without a calibration they must be rectified. With --workspace and --pair, pass only OUT.

    Args:
        left: Left image, whose pixels get the disparities (with --workspace: OUT).
        right: Right image.
        out: Output folder.
        config: Options.
        rig: The cameras.
        model: Two images of a reconstruction.
        strict: Exit with code 3 if any of several pairs could not be measured.
    """
    paths = [path for path in (left, right, out) if path is not None]
    if model != NO_MODEL:
        if model.workspace is None or model.pair is None or len(paths) != 1:
            raise ConfigError(
                "a pair of a reconstruction needs these arguments: --workspace W --pair A B OUT"
            )
        if rig != NO_RIG:
            raise ConfigError(
                "--workspace cannot be combined with a calibration, focal length or baseline: the model has its own cameras"
            )
        _measure_of_model(model.workspace, model.pair, left, config)
        return
    if right is None or out is None:
        raise ConfigError(f"`epipole stereo` needs LEFT RIGHT OUT, got {' '.join(map(str, paths))}")
    is_whole = _measure(left, right, out, config, rig)
    _exit_with(is_whole or not strict)


def stereo_doctor(
    left: Left,
    right: Right,
    rig: Annotated[RigOptions, tyro.conf.arg(name="")] = NO_RIG,
    json: bool = False,
    strict: bool = False,
) -> None:
    """Diagnose a stereo pair: swapped images, misaligned rows and their cause, missing synchronization, wrong units.

    Also prints the expected depth error at each depth. `epipole stereo doctor` is the same command.

    Args:
        left: Left image, folder or video.
        right: Right image, folder or video.
        rig: The cameras.
        json: Print JSON.
        strict: Exit with code 3 if there are problems.
    """
    is_healthy = _examine(left, right, rig, json)
    _exit_with(is_healthy or not strict)


def _exit_with(answer: bool) -> None:
    from epipole.screen import ANSWER_IS_NO

    if not answer:
        sys.exit(ANSWER_IS_NO)


def _examine(left: Path, right: Path, options: RigOptions, as_json: bool) -> bool:
    """Examine and print; whether there are no problems."""
    from epipole.screen import working

    with working():
        from epipole.pipelines.stereo.rigs import rig_of
        from epipole.pipelines.stereo.run import examine_stereo

        found = examine_stereo(left, right, rig_of(left, right, options))
    from epipole.io.json_files import json_text
    from epipole.pipelines.stereo.tables import show_diagnosis

    if as_json:
        print(json_text(asdict(found) | {"calibration_error_px": found.calibration_error_px}), end="")
    else:
        show_diagnosis(found)
    return found.is_healthy


def _measure(left: Path, right: Path, out: Path, config: StereoConfig, options: RigOptions) -> bool:
    """Measure one pair or many; whether all succeeded."""
    from epipole.io.images.video import is_video
    from epipole.screen import progress_on_screen, working

    if not (left.is_dir() or right.is_dir() or is_video(left) or is_video(right)):
        with working():
            from epipole.pipelines.stereo.rigs import rig_of
            from epipole.pipelines.stereo.run import stereo as run

            result = run(left, right, out, config, rig_of(left, right, options))
        from epipole.pipelines.stereo.tables import show_stereo

        show_stereo(result)
        return True
    with progress_on_screen({"video": "Taking frames", "pairs": "Measuring pairs"}) as progress:
        from epipole.pipelines.stereo.rigs import rig_of
        from epipole.pipelines.stereo.run import stereo_many

        batch = stereo_many(left, right, out, config, rig_of(left, right, options), progress)
    from epipole.pipelines.stereo.tables import show_batch

    show_batch(batch)
    if not (batch.done or batch.earlier):
        raise NoModelError("no pair could be measured")
    return not batch.problems


def _measure_of_model(workspace: Path, pair: tuple[str, str], out: Path, config: StereoConfig) -> None:
    from epipole.screen import working

    with working():
        from epipole.pipelines.stereo.run import stereo_of_model

        result = stereo_of_model(workspace, pair[0], pair[1], out, config)
    from epipole.pipelines.stereo.tables import show_stereo

    show_stereo(result)
