"""The commands, generated from typed functions; heavy imports wait until a command runs."""

from __future__ import annotations

import errno
import gc
import os
import sys
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from epipole.config import CalibrationConfig, CalibrationOptions, ReconstructConfig, RigOptions, StereoConfig
from epipole.errors import ConfigError, EpipoleError

Images = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES")]
Out = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
Target = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TARGET")]

Left = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LEFT")]
Right = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RIGHT")]
Paths = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LEFT RIGHT OUT")]

ANSWER_IS_NO = 3
"""Exit code of a check that ran and did not pass; errors have 1, wrong usage 2."""

_STEREO_FIELDS = {f.name.replace("_", "-"): str(f.type) for f in (*fields(StereoConfig), *fields(RigOptions))}
_FLAGS = {"json", "strict", *(name for name, kind in _STEREO_FIELDS.items() if kind == "bool")}
_TWO_VALUES = {
    "pair",
    "cameras",
    *(name for name, kind in _STEREO_FIELDS.items() if kind.startswith("tuple[")),
}

DEFAULTS = ReconstructConfig()
STEREO_DEFAULTS = StereoConfig()
RIG_DEFAULTS = RigOptions()
NO_CALIBRATION = CalibrationOptions()
CALIBRATION_DEFAULTS = CalibrationConfig()


def reconstruct(
    images: Images,
    out: Out,
    config: Annotated[ReconstructConfig, tyro.conf.arg(name="")] = DEFAULTS,
) -> None:
    """Make a 3D model from photographs. A new user needs no option.

    Args:
        images: Folder of photographs (sub-folders too), or a video file.
        out: Output folder; a stopped run continues there.
        config: Options.
    """
    from epipole.cli.screen import progress_on_screen, show_reconstruction

    with progress_on_screen(compiles_much=True) as progress:
        from epipole.api import reconstruct as run

        result = run(images, out, config, progress)
    show_reconstruction(result)


def stereo(
    paths: Paths,
    config: Annotated[StereoConfig, tyro.conf.arg(name="")] = STEREO_DEFAULTS,
    rig: Annotated[RigOptions, tyro.conf.arg(name="")] = RIG_DEFAULTS,
    calibrated: Annotated[CalibrationOptions, tyro.conf.arg(name="")] = NO_CALIBRATION,
    workspace: Path | None = None,
    pair: tuple[str, str] | None = None,
    strict: bool = False,
) -> None:
    """Disparities of a pair, each with its standard deviation; depth and points where the cameras are known.

    LEFT and RIGHT are two pictures, two folders, or two videos (twice the same one: both pictures side by side).
    Without a calibration they count as rectified.

    Args:
        paths: Left picture, whose pixels get the disparities; right picture; output folder.
        config: Options.
        rig: What is known of rectified cameras.
        calibrated: Where a calibration is read from.
        workspace: Output folder of a reconstruction to take two pictures from, in place of LEFT and RIGHT.
        pair: Names of these pictures.
        strict: Exit with code 3 where a pair of several could not be measured.
    """
    from epipole.cli.stereo import run_stereo

    is_whole = run_stereo(paths, config, rig, calibrated, (workspace, pair))
    if strict and not is_whole:
        sys.exit(ANSWER_IS_NO)


def stereo_doctor(
    left: Left,
    right: Right,
    rig: Annotated[RigOptions, tyro.conf.arg(name="")] = RIG_DEFAULTS,
    calibrated: Annotated[CalibrationOptions, tyro.conf.arg(name="")] = NO_CALIBRATION,
    json: bool = False,
    strict: bool = False,
) -> None:
    """What is wrong with a stereo pair: swapped, rows that do not match and why, not synchronous, odd units.

    Also the depth error to expect at each range. `epipole stereo doctor` is the same.

    Args:
        left: Left picture, folder or video.
        right: Right picture, folder or video.
        rig: What is known of rectified cameras.
        calibrated: Where a calibration is read from.
        json: Print JSON.
        strict: Exit with code 3 where something is wrong.
    """
    from epipole.cli.stereo import run_doctor

    is_healthy = run_doctor(left, right, rig, calibrated, as_json=json)
    if strict and not is_healthy:
        sys.exit(ANSWER_IS_NO)


def calibrate(
    images: Images,
    out: Out,
    config: Annotated[
        CalibrationConfig, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes
    ] = CALIBRATION_DEFAULTS,
    right: Path | None = None,
    strict: bool = False,
) -> None:
    """Calibrate a camera, or a pair of cameras, from pictures of a chessboard, ChArUco board or AprilTag grid.

    A pair's pictures lie in sub-folders left and right, or are named left01.jpg and right01.jpg.

    Args:
        images: Folder of pictures.
        out: Output folder.
        config: Board and options.
        right: Folder of the right camera's pictures, where it is not found by name.
        strict: Exit with code 3 where the calibration fails its checks; it is written all the same.
    """
    from epipole.cli.screen import progress_on_screen, show_calibration

    with progress_on_screen() as progress:
        from epipole.api import calibrate as run

        result = run(images, out, config, right, progress)
    show_calibration(result)
    if strict and not result.verdict.passes:
        sys.exit(ANSWER_IS_NO)


def demo(out: Out = Path("demo"), num_views: int = 24) -> None:
    """Render photographs of a made-up courtyard, reconstruct it, and compare with the exact truth.

    Args:
        out: Output folder; made anew.
        num_views: Photographs to render.
    """
    from epipole.cli.demo import run_demo

    run_demo(out, num_views)


def view(out: Out, port: int = 8080, host: str = "127.0.0.1") -> None:
    """Show a model, or the depth of a pair, in the browser.

    Args:
        out: Output folder of a reconstruction or of `stereo`, or a COLMAP model.
        port: Where the viewer listens.
        host: On which address.
    """
    from epipole.api import view as run

    handle = run(out, port=port, host=host, block=False)
    print(f"Viewer at {handle.url} (Ctrl-C stops it)")
    import threading

    threading.Event().wait()


def evaluate(out: Out, truth: Path, json: bool = False) -> None:
    """Compare a model's cameras with known ones.

    Args:
        out: Output folder of a reconstruction, or a COLMAP model.
        truth: COLMAP model, folder of Strecha .camera files, or Middlebury _par.txt file.
        json: Print JSON.
    """
    from epipole.api import evaluate as run
    from epipole.cli.screen import show_evaluation

    result = run(out, truth)
    if json:
        from json import dumps

        print(dumps(asdict(result), indent=2))
    else:
        show_evaluation(result)


def undistort(out: Out) -> None:
    """Write OUT/undistorted: pictures without distortion and a PINHOLE model, for splat trainers and MVS.

    Args:
        out: Output folder of a reconstruction.
    """
    from epipole.api import undistort as run
    from epipole.cli.screen import progress_on_screen

    with progress_on_screen() as progress:
        target = run(out, progress)
    print(f"Undistorted pictures and model in {target}")


def convert(
    source: Out, target: Target, format: Literal["txt", "bin", "ply", "transforms", "bundler"]
) -> None:
    """Write a model in another format.

    Args:
        source: Output folder of a reconstruction, or a model.
        target: Where to write.
        format: COLMAP txt or bin, PLY, nerfstudio transforms.json, or Bundler.
    """
    from epipole.api import find_model
    from epipole.io.convert import convert_model

    source = source if source.is_file() else find_model(source)
    print(f"Written {convert_model(source, target, format)}")


def version() -> None:
    """Print the version."""
    from epipole import __version__

    print(f"epipole {__version__}")


COMMANDS: tuple[Callable[..., None], ...] = (
    reconstruct,
    stereo,
    stereo_doctor,
    calibrate,
    demo,
    view,
    evaluate,
    undistort,
    convert,
    version,
)


def paths_first(given: list[str]) -> list[str]:
    """The same with the paths before the options, for those that take several values would swallow them.

    `--calibration` takes one file or two: as many as leave enough paths.

    Raises:
        ConfigError: `--calibration` has no file.
    """
    command, rest = given[0], [part for word in given[1:] for part in _split(word)]
    wanted = 2 if command == "stereo-doctor" else 1 if "--workspace" in rest else 3
    paths: list[str] = []
    options: list[str] = []
    files: list[tuple[int, list[str]]] = []  # words after --calibration, and how many paths were before them
    while rest:
        word = rest.pop(0)
        if word == "--calibration":
            end = next((k for k, value in enumerate(rest) if value.startswith("--")), len(rest))
            if not end:
                raise ConfigError("--calibration needs a file (an unset variable?)")
            files.append((len(paths), rest[:end]))
            rest = rest[end:]
        elif word == "-h" or (word.startswith("--") and word != "--"):
            count = _num_values(word)
            options += [word, *rest[:count]]
            rest = rest[count:]
        elif word != "--":
            paths.append(word)
    second = len(paths) + sum(len(words) for _, words in files) - wanted - len(files)  # files beyond one each
    taken: list[str] = []
    for place, words in reversed(files):
        count = 2 if second > 0 and len(words) > 1 else 1
        second -= count - 1
        taken = words[:count] + taken
        paths[place:place] = words[count:]
    return [command, *paths, *options, *(["--calibration", *taken] if files else [])]


def _split(word: str) -> list[str]:
    """`--option=value` as two words."""
    name, equals, value = word.partition("=")
    return [name, value] if equals and name.startswith("--") else [word]


def _num_values(option: str) -> int:
    """How many words follow an option of the stereo commands."""
    name = option.removeprefix("--")
    if name.removeprefix("no-") in _FLAGS or name in ("help", "-h"):
        return 0
    return 2 if name in _TWO_VALUES else 1


def main(arguments: list[str] | None = None) -> None:
    """Run a command; errors that are meant for the user become one line and exit code 1."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if "" in given:
        print("epipole: a word of the command is empty (an unset variable?)", file=sys.stderr)
        sys.exit(2)
    if given[:2] == ["stereo", "doctor"]:
        given = ["stereo-doctor", *given[2:]]
    # Modules and kernels are many small objects that stay: to look through them again and again for cycles took
    # an eighth of a short run.
    gc.set_threshold(200_000, 20, 100)
    try:
        _dispatch(paths_first(given) if given[:1] in (["stereo"], ["stereo-doctor"]) else given)
    except EpipoleError as error:
        print(f"epipole: {error}", file=sys.stderr)
        sys.exit(1)
    except BrokenPipeError:  # the reader of our output has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        print(
            f"epipole: {error.strerror}: {error.filename or 'see where EPIPOLE_CACHE_DIR points'}",
            file=sys.stderr,
        )
        sys.exit(1)
    except KeyboardInterrupt:
        note = "epipole: stopped. What was finished is kept; the same command goes on from there."
        print(f"\n{note}" if given[:1] == ["reconstruct"] else "", file=sys.stderr)
        sys.exit(130)


def _dispatch(given: list[str]) -> None:
    app: Any = tyro.extras.SubcommandApp()
    for command in COMMANDS:
        app.command(command)
    app.cli(prog="epipole", description="Photographs to space.", args=given)


if __name__ == "__main__":
    main()
