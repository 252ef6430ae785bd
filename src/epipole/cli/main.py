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

from epipole.config import ReconstructConfig, RigOptions, StereoConfig
from epipole.errors import EpipoleError

Images = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES")]
Out = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
Target = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TARGET")]

Left = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LEFT")]
Right = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RIGHT")]

DEFAULTS = ReconstructConfig()
STEREO_DEFAULTS = StereoConfig()
RIG_DEFAULTS = RigOptions()


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

    with progress_on_screen() as progress:
        from epipole.api import reconstruct as run

        result = run(images, out, config, progress)
    show_reconstruction(result)


def stereo(
    left: Left,
    right: Right,
    out: Out,
    config: Annotated[StereoConfig, tyro.conf.arg(name="")] = STEREO_DEFAULTS,
    rig: Annotated[RigOptions, tyro.conf.arg(name="")] = RIG_DEFAULTS,
) -> None:
    """Disparities of a rectified pair, each with its standard deviation; depth and points where the rig is known.

    Args:
        left: Left picture; its pixels get the disparities.
        right: Right picture, rectified with it.
        out: Output folder.
        config: Options.
        rig: What is known of the cameras.
    """
    from epipole.cli.screen import show_stereo, waiting_for_kernels

    with waiting_for_kernels():
        from epipole.api import stereo as run
        from epipole.io.photographs import read_header
        from epipole.stereo.depth import rig_from_options

        header = read_header(left)
        cameras = rig_from_options(rig, (header.width, header.height))
        result = run(left, right, out, config, cameras)
    show_stereo(result)


def demo(out: Out = Path("demo"), num_views: int = 24) -> None:
    """Render photographs of a made-up courtyard, reconstruct it, and compare with the exact truth.

    Args:
        out: Output folder; made anew.
        num_views: Photographs to render.
    """
    from epipole.cli.demo import run_demo

    run_demo(out, num_views)


def view(out: Out, port: int = 8080, host: str = "127.0.0.1") -> None:
    """Show a model in the browser.

    Args:
        out: Output folder of a reconstruction, or a COLMAP model.
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
    demo,
    view,
    evaluate,
    undistort,
    convert,
    version,
)


def main(arguments: list[str] | None = None) -> None:
    """Run a command; errors that are meant for the user become one line and exit code 1."""
    given = sys.argv[1:] if arguments is None else arguments
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
