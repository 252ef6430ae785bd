"""The command line: the list of commands, each generated from a typed function; heavy imports wait until one runs."""

from __future__ import annotations

import errno
import gc
import os
import sys
from importlib import import_module
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, get_args, get_origin

import tyro

from epipole.errors import EpipoleError

COMMANDS = (
    "epipole.pipelines.sfm.command:reconstruct",
    "epipole.pipelines.stereo.command:stereo",
    "epipole.pipelines.stereo.command:stereo_doctor",
    "epipole.pipelines.calibration.command:calibrate",
    "epipole.pipelines.demo.command:demo",
    "epipole.cli.main:view",
    "epipole.pipelines.evaluation.command:evaluate",
    "epipole.pipelines.undistortion.command:undistort",
    "epipole.pipelines.conversion.command:convert",
    "epipole.cli.main:version",
)
"""Module and function of every command."""


def view(
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    port: int = 8080,
    host: str = "127.0.0.1",
) -> None:
    """Show a model, or the depth of a pair, in the browser.

    Args:
        out: Output folder of a reconstruction or of `stereo`, or a COLMAP model.
        port: The port to listen on; the next free one if it is in use.
        host: The address to listen on.
    """
    import threading

    from epipole.api import view as run

    handle = run(out, port=port, host=host, block=False)
    print(f"Viewer at {handle.url} (Ctrl-C stops it)")
    threading.Event().wait()


def version() -> None:
    """Print the version."""
    from epipole._version import __version__

    print(f"epipole {__version__}")


def main(arguments: list[str] | None = None) -> None:
    """Run a command; errors that are meant for the user become one line and exit code 1."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if "" in given:
        print("epipole: an argument is empty (an unset variable?)", file=sys.stderr)
        sys.exit(2)
    if given[:2] == ["stereo", "doctor"]:
        given = ["stereo-doctor", *given[2:]]
    # Modules and kernels are many small objects that stay alive: searching them for cycles again and again
    # took an eighth of a short run.
    gc.set_threshold(200_000, 20, 100)
    try:
        _dispatch(given)
    except EpipoleError as error:
        print(f"epipole: {error}", file=sys.stderr)
        sys.exit(1)
    except BrokenPipeError:  # whoever reads the output has closed it (`| head`)
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
        note = "epipole: stopped. What was finished is kept; the same command continues from there."
        print(f"\n{note}" if given[:1] == ["reconstruct"] else "", file=sys.stderr)
        sys.exit(130)


def _dispatch(given: list[str]) -> None:
    app: Any = tyro.extras.SubcommandApp()
    for place in COMMANDS:
        module, name = place.split(":")
        app.command(getattr(import_module(module), name))
    app.cli(prog="epipole", description="Photographs to space.", args=given, registry=_registry())


def _registry() -> tyro.constructors.ConstructorRegistry:
    """Tyro's parsing of types, except that an option of two values always takes exactly two words.

    Tyro reads `tuple[int, int] | None` as two words or the word None, and gives it all words up to the next
    option, paths included.
    """
    registry = tyro.constructors.ConstructorRegistry()
    registry.primitive_rule(_two_values_or_none)
    return registry


def _two_values_or_none(
    info: tyro.constructors.PrimitiveTypeInfo,
) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
    members = [member for member in get_args(info.type) if member is not NoneType]
    if NoneType not in get_args(info.type) or len(members) != 1 or get_origin(members[0]) is not tuple:
        return None
    kinds = get_args(members[0])
    if len(kinds) != 2 or not all(kind in (int, float, str) for kind in kinds):
        return None
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=2,
        metavar=" ".join(kind.__name__.upper() for kind in kinds),
        instance_from_str=lambda words: tuple(kind(word) for kind, word in zip(kinds, words)),
        is_instance=lambda value: value is None or isinstance(value, tuple),
        str_from_instance=lambda value: ["none"] if value is None else [str(part) for part in value],
    )


if __name__ == "__main__":
    main()
