"""The commands, generated from typed functions; heavy imports wait until a command runs."""

from __future__ import annotations

import errno
import gc
import os
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from epipole.config import CalibrationConfig, ReconstructConfig, RigOptions, StereoConfig
from epipole.errors import EpipoleError

Images = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES")]
Out = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
Target = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TARGET")]

Left = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LEFT")]
Right = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RIGHT")]
Paths = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LEFT RIGHT OUT")]

ANSWER_IS_NO = 3
"""Exit code of a check that ran and did not pass; errors have 1, wrong usage 2."""

DEFAULTS = ReconstructConfig()
STEREO_DEFAULTS = StereoConfig()
RIG_DEFAULTS = RigOptions()
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
    calibration: tuple[Path, ...] = (),
    cameras: tuple[int, int] | None = None,
    workspace: Path | None = None,
    pair: tuple[str, str] | None = None,
) -> None:
    """Disparities of a pair, each with its standard deviation; depth and points where the cameras are known.

    LEFT and RIGHT are two pictures, two folders, or two videos (twice the same one: both pictures side by side).
    Without a calibration they count as rectified.

    Args:
        paths: Left picture, whose pixels get the disparities; right picture; output folder.
        config: Options.
        rig: What is known of rectified cameras.
        calibration: File of both cameras, of epipole, OpenCV, Kalibr, KITTI or Middlebury; or two files (ROS' or EuRoC's
            left and right, OpenCV's intrinsics and extrinsics). The pair is rectified by it.
        cameras: Left and right camera of a calibration that has more than two, counted from 0.
        workspace: Output folder of a reconstruction to take two pictures from, in place of LEFT and RIGHT.
        pair: Names of these pictures.
    """
    from epipole.cli.stereo import CalibrationGiven, run_stereo

    run_stereo(paths, config, rig, CalibrationGiven(calibration, cameras), (workspace, pair))


def stereo_doctor(
    left: Left,
    right: Right,
    rig: Annotated[RigOptions, tyro.conf.arg(name="")] = RIG_DEFAULTS,
    calibration: tuple[Path, ...] = (),
    cameras: tuple[int, int] | None = None,
    json: bool = False,
    strict: bool = False,
) -> None:
    """What is wrong with a stereo pair: swapped, rows that do not match and why, not synchronous, odd units.

    Also the depth error to expect at each range. `epipole stereo doctor` is the same.

    Args:
        left: Left picture, folder or video.
        right: Right picture, folder or video.
        rig: What is known of rectified cameras.
        calibration: As for `stereo`.
        cameras: As for `stereo`.
        json: Print JSON.
        strict: Exit with code 3 where something is wrong.
    """
    from epipole.cli.stereo import CalibrationGiven, run_doctor

    is_healthy = run_doctor(left, right, rig, CalibrationGiven(calibration, cameras), as_json=json)
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
    """The same with the paths before the options that take several values, which would swallow them."""
    out: list[str] = []
    paths: list[str] = []
    command, rest = given[0], given[1:]
    wanted = 2 if command == "stereo-doctor" else 1 if "--workspace" in rest else 3
    while rest and not rest[0].startswith("-"):
        out.append(rest.pop(0))
    wanted -= len(out)
    while rest:
        word = rest.pop(0)
        out.append(word)
        if word not in ("--pair", "--cameras", "--calibration"):
            continue
        end = next((k for k, value in enumerate(rest) if value.startswith("--")), len(rest))
        values, rest = rest[:end], rest[end:]
        most = max(1, len(values) - wanted) if word == "--calibration" else 2
        if len(values) > most:
            paths += values[most:]
            values = values[:most]
        out += values
    return [command, *paths, *out]


def main(arguments: list[str] | None = None) -> None:
    """Run a command; errors that are meant for the user become one line and exit code 1."""
    given = sys.argv[1:] if arguments is None else arguments
    if given[:2] == ["stereo", "doctor"]:
        given = ["stereo-doctor", *given[2:]]
    if given[:1] in (["stereo"], ["stereo-doctor"]):
        given = paths_first(given)
    # Modules and kernels are many small objects that stay: to look through them again and again for cycles took
    # an eighth of a short run.
    gc.set_threshold(200_000, 20, 100)
    try:
        _dispatch(given)
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
