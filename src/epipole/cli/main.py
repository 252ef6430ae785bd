"""The command line: commands generated from typed functions, with heavy imports deferred until one runs."""

from __future__ import annotations

import contextlib
import errno
import functools
import gc
import io
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from importlib import import_module
from types import NoneType
from typing import Annotated, Any, Literal, NoReturn, get_args, get_origin

import tyro

from epipole._terminal import in_words_of_caller, one_line, say, wording
from epipole.cli.help import ALL, command_list, help_text, is_asked_for
from epipole.errors import ConfigError, EpipoleError, FileFormatError

COMMANDS = (
    "epipole.pipelines.sfm.command:reconstruct",
    "epipole.pipelines.sfm.command:merge",
    "epipole.pipelines.localization.command:localize",
    "epipole.pipelines.georeferencing.command:georeference",
    "epipole.pipelines.surfaces.command:surface",
    "epipole.pipelines.slam.command:slam",
    "epipole.pipelines.fields.command:splat",
    "epipole.pipelines.fields.command:nerf",
    "epipole.pipelines.fields.command:render",
    "epipole.pipelines.fields.command:mesh",
    "epipole.pipelines.fields.command:compare_fields",
    "epipole.pipelines.stereo.command:stereo",
    "epipole.pipelines.stereo.command:stereo_doctor",
    "epipole.pipelines.calibration.command:calibrate",
    "epipole.pipelines.demo.command:demo",
    "epipole.lesson.command:lesson",
    "epipole.pipelines.viewing.command:view",
    "epipole.pipelines.evaluation.command:evaluate",
    "epipole.pipelines.undistortion.command:undistort",
    "epipole.pipelines.conversion.command:convert",
    "epipole.cli.main:completion",
    "epipole.cli.main:version",
)
"""Module and function of every command."""
ANSWERING = ("stereo-doctor", "lesson", "view", "evaluate", "completion", "version")
"""Commands whose output is their result, which --quiet keeps."""
WRITING_NOTHING = ("stereo-doctor", "evaluate", "completion", "version")
"""Commands that never write files."""
EVERYWHERE = {
    **{"-q": "quiet", "--quiet": "quiet"},
    **{"-v": "verbose", "--verbose": "verbose"},
    **{"-V": "version", "--version": "version"},
    "--overwrite": "overwrite",
}
"""Options of all commands, before or after the command's name."""
OTHER_VALUES = {("--output", "colour"): "color"}
"""Other spellings of an option's value, each with the one that the command takes."""
WRONG_USAGE = 2

logger = logging.getLogger("epipole")


def version() -> None:
    """Print the version."""
    from epipole._version import __version__

    say(f"epipole {__version__}")


def completion(shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]) -> None:
    """Print a script with which a shell completes commands and options.

    Args:
        shell: Your shell.
    """
    _parsed_by_tyro(["--tyro-print-completion", shell], _functions())


def main(arguments: list[str] | None = None) -> None:
    """Run a command; errors meant for the user are printed as one line, with exit code 1, or 2 for wrong usage."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    requested = {EVERYWHERE[word] for word in words if word in EVERYWHERE}
    words = _in_usual_spelling([word for word in words if word not in EVERYWHERE])
    if "" in words:
        _refuse("an argument is empty (is a shell variable unset?)", WRONG_USAGE)
    if {"quiet", "verbose"} <= requested:
        _refuse("--quiet and --verbose exclude each other", WRONG_USAGE)
    if "version" in requested:
        words = ["version"]
    if words[:1] == ["help"]:
        words = [*words[1:2], "--help"]
    if words[:2] == ["stereo", "doctor"]:
        words = ["stereo-doctor", *words[2:]]
    if "overwrite" in requested and words[:1] and words[0] in WRITING_NOTHING:
        _refuse(f"`epipole {words[0]}` writes no files: remove --overwrite", WRONG_USAGE)
    # Modules and kernels are many small objects that stay alive; repeated garbage collection of them took an eighth
    # of a short run.
    gc.set_threshold(200_000, 20, 100)
    if "verbose" not in requested:  # silence FFmpeg's messages about damaged video; ours name the file
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    with _loudness(requested, words), _warnings_in_one_line(), _overwriting(requested):
        _run(words)


def _in_usual_spelling(words: list[str]) -> list[str]:
    """The words, with the spellings of values that the parser knows."""
    after = [OTHER_VALUES.get(pair, pair[1]) for pair in zip(["", *words], words)]
    joined = {f"{option}={value}": f"{option}={usual}" for (option, value), usual in OTHER_VALUES.items()}
    return [joined.get(word, word) for word in after]


def _run(words: list[str]) -> None:
    try:
        call = _parsed(words)
        with _unwrapped(), wording(lambda text: _with_options(text, words, also_plain=False)):
            call()
    except EpipoleError as error:
        logger.debug("where it was raised", exc_info=True)
        code = WRONG_USAGE if isinstance(error, ConfigError) else 1
        _refuse(one_line(_as_options(error, words, while_parsing=False)), code)
    except BrokenPipeError:  # the reader of the output has closed it (`| head`)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        if error.errno != errno.ENOSPC and error.filename is None:
            raise
        logger.debug("where it was raised", exc_info=True)
        _refuse(f"{error.strerror}: {error.filename or 'check EPIPOLE_CACHE_DIR'}", 1)
    except KeyboardInterrupt:
        note = (
            "epipole: interrupted. Finished work is kept; run the same command again to continue or restart."
        )
        say("" if words[:1] in (["lesson"], ["view"]) else f"\n{note}", to_stderr=True)
        sys.exit(130)


@contextlib.contextmanager
def _unwrapped() -> Iterator[None]:
    """Do not wrap lines if the output is not a terminal, so that paths can be copied."""
    if sys.stdout.isatty() or "COLUMNS" in os.environ:
        yield
        return
    os.environ["COLUMNS"] = "1000"
    try:
        yield
    finally:
        os.environ.pop("COLUMNS", None)


@contextlib.contextmanager
def _warnings_in_one_line() -> Iterator[None]:
    """Print warnings of the package as notes for the user, without a source location."""
    with warnings.catch_warnings():
        plain = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *rest: Any, **named: Any) -> None:
            if category is RuntimeWarning and str(message).startswith("epipole: "):
                say(one_line(in_words_of_caller(str(message))), to_stderr=True)
            else:
                plain(message, category, *rest, **named)

        warnings.showwarning = show
        yield


def _refuse(message: str, code: int) -> NoReturn:
    say(f"epipole: {message}", to_stderr=True)
    sys.exit(code)


@contextlib.contextmanager
def _loudness(requested: set[str], words: list[str]) -> Iterator[None]:
    """Set what is printed besides errors: results only, the default, or everything."""
    if not requested & {"quiet", "verbose"}:
        yield
        return
    from epipole import screen

    with contextlib.ExitStack() as stack:
        stack.enter_context(screen.loudness("quiet" if "quiet" in requested else "verbose"))
        if "quiet" in requested and words[:1] and words[0] not in ANSWERING:
            stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
        if "verbose" in requested:
            from epipole._version import __version__

            logger.debug("epipole %s, Python %s, arguments %s", __version__, sys.version.split()[0], words)
        yield


@contextlib.contextmanager
def _overwriting(requested: set[str]) -> Iterator[None]:
    if "overwrite" not in requested:
        yield
        return
    from epipole.runs.guard import overwriting

    with overwriting():
        yield


def _functions() -> dict[str, Callable[..., None]]:
    """Function of every command, by the command's name."""
    positions = [position.split(":") for position in COMMANDS]
    found = [getattr(import_module(module), name) for module, name in positions]
    return {function.__name__.replace("_", "-"): function for function in found}


def _parsed(words: list[str]) -> Callable[[], None]:
    """Parse the words into a call; prints help, and explains wrong usage."""
    functions = _functions()
    if words[:1] in ([], ["-h"], ["--help"], [ALL]):
        say(command_list(functions), to_stderr=not words)
        sys.exit(0 if words else WRONG_USAGE)
    if words[0] not in functions and not words[0].startswith("--tyro"):
        from epipole.cli.mistakes import unknown_command

        _refuse(unknown_command(words[0], list(functions)), WRONG_USAGE)
    if is_asked_for(words, functions):
        text = help_text(
            words[0], lambda: _parsed_by_tyro([words[0], "--help"], functions), is_whole=ALL in words
        )
        say(text)
        sys.exit(0)
    return _parsed_by_tyro(words, functions)


def _parsed_by_tyro(words: list[str], functions: dict[str, Callable[..., None]]) -> Callable[[], None]:
    calls: list[Callable[[], None]] = []
    app: Any = tyro.extras.SubcommandApp()
    for function in functions.values():
        app.command(_noted(function, calls))
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), _unwrapped():
            app.cli(
                prog="epipole",
                args=words,
                registry=_registry(),
            )
    except ConfigError as error:
        _refuse(_as_options(error, words, while_parsing=True), WRONG_USAGE)
    except SystemExit as stopped:
        if not stopped.code:
            raise
        _refuse(_why_stopped(words, stopped, said.getvalue()), WRONG_USAGE)
    return calls[0]


def _noted(function: Callable[..., None], calls: list[Callable[[], None]]) -> Callable[..., None]:
    """The same command, which only records its call, so that parsing ends before anything runs."""

    @functools.wraps(function)
    def note(*arguments: Any, **options: Any) -> None:
        calls.append(functools.partial(function, *arguments, **options))

    return note


def _why_stopped(words: list[str], stopped: SystemExit, said: str) -> str:
    """Reason why the parser stopped: a config rejected its values, or the words are wrong."""
    from epipole.cli.mistakes import in_one_sentence
    from epipole.cli.options import required_arguments

    cause: BaseException | None = stopped
    while cause is not None:
        if isinstance(cause, ConfigError):
            return _as_options(cause, words, while_parsing=True)
        cause = cause.__cause__ or cause.__context__
    functions = _functions()
    required = required_arguments(functions[words[0]]) if words and words[0] in functions else []
    return in_one_sentence(said, words, required)


def _as_options(error: EpipoleError, words: list[str], *, while_parsing: bool) -> str:
    """Message of an error, with config fields replaced by the command's options.

    Errors about the contents of a file remain: the file may have keys with the names of fields.
    """
    if isinstance(error, FileFormatError):
        return str(error)
    return _with_options(str(error), words, also_plain=while_parsing and isinstance(error, ConfigError))


def _with_options(message: str, words: list[str], *, also_plain: bool) -> str:
    from epipole.cli.mistakes import with_option_names
    from epipole.cli.options import option_names

    return with_option_names(message, words, option_names(_functions()[words[0]]), also_plain=also_plain)


def _registry() -> tyro.constructors.ConstructorRegistry:
    """Tyro's parsing of types, except that an option with several values always takes exactly that many words.

    Tyro would parse `tuple[int, int] | None` as two words or the word None, and give it all words up to the next
    option, including paths.
    """
    registry = tyro.constructors.ConstructorRegistry()
    registry.primitive_rule(_values_or_none)
    return registry


def _values_or_none(
    info: tyro.constructors.PrimitiveTypeInfo,
) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
    members = [member for member in get_args(info.type) if member is not NoneType]
    if NoneType not in get_args(info.type) or len(members) != 1 or get_origin(members[0]) is not tuple:
        return None
    kinds = get_args(members[0])
    if not all(kind in (int, float, str) for kind in kinds):
        return None
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=len(kinds),
        metavar=" ".join(kind.__name__.upper() for kind in kinds),
        instance_from_str=lambda words: tuple(kind(word) for kind, word in zip(kinds, words)),
        is_instance=lambda value: value is None or isinstance(value, tuple),
        str_from_instance=lambda value: ["none"] if value is None else [str(part) for part in value],
    )


if __name__ == "__main__":
    main()
