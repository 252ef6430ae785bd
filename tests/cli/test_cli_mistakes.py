"""Wrong usage is one sentence, in the user's own spelling, and exit code 2; options that every command takes."""

import dataclasses
import logging
import re
import sys
import warnings

import pytest

from epipole import screen
from epipole.cli import main as command_line
from epipole.cli.main import COMMANDS, _functions, _in_usual_spelling, _parsed, main
from epipole.cli.mistakes import with_option_names
from epipole.cli.options import option_names
from epipole.errors import NoModelError
from epipole.pipelines.sfm.config import ReconstructConfig

OPTIONS = {name: option_names(function) for name, function in _functions().items()}


def refused(given: str, capsys: pytest.CaptureFixture, code: int = 2) -> str:
    with pytest.raises(SystemExit) as stopped:
        main(given.split())
    said = capsys.readouterr()
    assert stopped.value.code == code and said.out == ""
    assert said.err.startswith("epipole: ") and said.err.count("\n") == 1
    assert not any(word in said.err for word in ("tyro", "dummy", "Traceback", "╭", "│"))
    return said.err.removeprefix("epipole: ").rstrip()


def test_without_a_command_the_commands_are_listed(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stopped:
        main([])
    said = capsys.readouterr()
    assert stopped.value.code == 2 and said.out == ""
    assert "usage: epipole COMMAND" in said.err and "reconstruct" in said.err


@pytest.mark.parametrize(
    ("given", "parts"),
    [
        ("reconstrut a b", ["unknown command reconstrut", "did you mean `epipole reconstruct`?"]),
        ("share --help", ["unknown command share", "did you mean `epipole view PATH --share FILE`?"]),
        ("--nosuch", ["unknown command --nosuch; `epipole --help` lists all commands"]),
        (
            "reconstruct",
            ["`epipole reconstruct` needs IMAGES OUT, got nothing", "see `epipole reconstruct --help`"],
        ),
        ("reconstruct a", ["`epipole reconstruct` needs IMAGES OUT, got a;"]),
        (
            "reconstruct a b c",
            [
                "unexpected argument c: `epipole reconstruct` takes only IMAGES OUT; see `epipole reconstruct --help`"
            ],
        ),
        ("slam a b --nosuch 4", ["unknown option --nosuch; see `epipole slam --help`"]),
        (
            "reconstruct a b --max-features 9",
            ["unknown option --max-features; did you mean --features.max-features?"],
        ),
        ("reconstruct a b --sinle-camera", ["unknown option --sinle-camera; did you mean --single-camera?"]),
        ("reconstruct a b --columns 0", ["unknown option --columns;"]),
        (
            "reconstruct a b --pairing.method sequental",
            [
                "--pairing.method must be auto, exhaustive, sequential, spatial or retrieval, got sequental;",
                "; did you mean sequential?",
            ],
        ),
        (
            "reconstruct a b --features.max-features abc",
            ["--features.max-features must be a whole number, got abc; see `epipole reconstruct --help`"],
        ),
        ("reconstruct a b --features.max-features", ["--features.max-features needs a value; see"]),
        ("reconstruct a b --camera-params", ["--camera-params needs a value: FX,FY,CX,CY; see"]),
        ("reconstruct a b --threads two", ["--threads must be a whole number, got two;"]),
        ("reconstruct a b --threads=", ["--threads must be a whole number, got nothing;"]),
        ("slam a b --max-frames 1.5", ["--max-frames must be a whole number, got 1.5;"]),
        ("stereo a b c --window 5", ["--window needs 2 values: WIDTH HEIGHT;"]),
        ("stereo a b c --window 5 x", ["--window must be 2 whole numbers (WIDTH HEIGHT), got 5 x;"]),
        ("mesh a b --box 1 2 3 4 5 x", ["--box must be 6 numbers (X Y Z X Y Z), got 1 2 3 4 5 x;"]),
        ("completion tcsh", ["must be bash, zsh or fish, got tcsh; see `epipole completion --help`"]),
        ("render a b --output purple", ["--output must be color, depth, normals or coverage, got purple;"]),
        ("evaluate a", ["`epipole evaluate` needs OUT --truth, got a;"]),
        (
            "convert a b",
            ["unknown output format of ", "one of txt, bin, ply, transforms, bundler, opensfm, "],
        ),
        (
            "convert a b --format obj",
            [
                "--format must be bin, bundler, chan, kapture, metashape, opensfm, ply, realityscan, splat, transforms, txt or usd, got obj;"
            ],
        ),
        ("--quiet --verbose version", ["exclude each other"]),
    ],
)
def test_wrong_words(given, parts, capsys):
    said = refused(given, capsys)
    assert all(part in said for part in parts), said


@pytest.mark.parametrize("given", [["--output", "colour"], ["--output=colour"]])
def test_the_british_spelling_of_a_value_is_accepted(given):
    assert _parsed(_in_usual_spelling(["render", "a", "b", *given])).keywords["config"].output == "color"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("calibrate a b --columns 0", "a chessboard needs at least 3 --columns and --rows, got 0 x 6"),
        ("calibrate a b --square nan", "--square must be a number, got NaN"),
        (
            "reconstruct a b --features.max-features 0",
            "--features.max-features must be at least 1 and --features.max-size-px at least 16",
        ),
        ("reconstruct a b --threads=0", "--threads must be at least 1, got 0"),
        (
            "reconstruct a b --verification.max_error_px 0",
            "--verification.max-error-px must be positive, got 0.0",
        ),
        (
            "reconstruct a b --mapper.max-error-px nan",
            "--mapper.max-error-px must be a number, got NaN",
        ),
        ("stereo a b c --window 4 5", "--window must have odd sides and 3 to 121 pixels, got (4, 5)"),
    ],
)
def test_values_that_a_config_refuses_name_the_option_as_it_was_given(given, said, capsys):
    assert refused(given, capsys) == said


def test_a_config_of_a_run_names_options_too_but_leaves_words_alone(capsys):
    assert refused("stereo a b --paths 4", capsys) == "`epipole stereo` needs LEFT RIGHT OUT, got a b"


def test_a_field_beside_an_option_is_written_as_one():
    words, options = ["reconstruct", "a", "b", "--include", "*"], OPTIONS["reconstruct"]
    message = "include and exclude select images of a folder, but x.mp4 is a video"
    said = with_option_names(message, words, options, also_plain=False)
    assert said == "--include and --exclude select images of a folder, but x.mp4 is a video"


@pytest.mark.parametrize(
    ("command", "message", "said"),
    [
        ("slam", "localize needs a map: pass map", "--localize needs a map: pass --map"),
        ("mesh", "cameras look at the scene (option cameras)", "cameras look at the scene (--cameras)"),
        (
            "splat",
            "reduce the image size (max_side_px), or pass steps",
            "reduce the image size (--max-side-px), or pass --steps",
        ),
        ("slam", "give a rig, or pass map= and truth", "give a rig, or pass --map and --truth"),
        ("render", "path=cameras needs cameras (path=orbit)", "--path cameras needs cameras (--path orbit)"),
        ("slam", "localize=True needs a map", "--localize needs a map"),
        ("slam", "the map of x.json: a map=3 is none", "the map of x.json: a map=3 is none"),
    ],
)
def test_what_a_message_asks_for_is_an_option(command, message, said):
    words = [command, "a", "b", "--localize"]
    assert with_option_names(message, words, OPTIONS[command], also_plain=False) == said


def test_a_warning_names_options(capsys, monkeypatch):
    def warned(out: str) -> None:
        """Warn."""
        warnings.warn("epipole: pass max_side_px, or steps", RuntimeWarning, stacklevel=1)
        screen.print_warnings(screen.open_console(), ["reduce the size (max_side_px)"])
        raise NoModelError("pass camera_params or a calibration")

    monkeypatch.setattr(command_line, "_functions", lambda: {"warned": warned})
    monkeypatch.setattr(
        "epipole.cli.options.option_names",
        lambda _: {"--max-side-px": "max_side_px", "--camera-params": "camera_params"},
    )
    with pytest.raises(SystemExit):
        main(["warned", "--out", "x"])
    said = "".join(capsys.readouterr())
    assert "epipole: pass --max-side-px, or steps" in said and "note: reduce the size (--max-side-px)" in said
    assert "epipole: pass --camera-params or a calibration" in said


def test_the_options_of_a_command_are_those_of_its_help(capsys):
    assert len(OPTIONS) == len(COMMANDS)
    for name, named in OPTIONS.items():
        with pytest.raises(SystemExit) as stopped:
            main([name, "--help-all"])
        assert stopped.value.code == 0
        assert named.keys() <= set(re.findall(r"--[\w.-]+", capsys.readouterr().out)), name
    fields = {f.name for f in dataclasses.fields(ReconstructConfig)}
    assert {"threads", "masks"} <= fields & set(OPTIONS["reconstruct"].values())


@pytest.mark.parametrize("given", ["--version", "-V", "version", "reconstruct --version", "-q version"])
def test_the_version(given, capsys):
    try:
        main(given.split())
    except SystemExit as stopped:
        assert not stopped.code
    assert capsys.readouterr().out.startswith("epipole 0.")


def speaking(out: str, strict: bool = False) -> None:
    """Speak."""
    sys.stdout.write(f"said {out} {strict}\n")
    logging.getLogger("epipole.anything").debug("thought")
    with screen.progress_on_screen({"a": "Doing"}) as show:
        from epipole.runs import Progress

        show(Progress("a", 0, 2))
        show(Progress("a", 1, 2))
        show(Progress("a", 2, 2))


@pytest.mark.parametrize("position", ["before", "after"])
@pytest.mark.parametrize("flag", ["-q", "--quiet", "-v", "--verbose", ""])
def test_quiet_and_verbose_before_and_after_the_command(flag, position, capsys, monkeypatch):
    monkeypatch.setattr(command_line, "_functions", lambda: {"speaking": speaking, "silent": speaking})
    own = ["speaking", "--out", "x", "--strict"]
    main(
        [
            *([flag] if flag and position == "before" else []),
            *own,
            *([flag] if flag and position == "after" else []),
        ]
    )
    said = capsys.readouterr()
    if flag.strip("-")[:1] == "q":
        assert said.out == "" and said.err == ""
        return
    assert said.out == "said x True\n"
    assert "Doing: started, 2 to do" in said.err and "Doing: 2 of 2 after" in said.err
    assert ("Doing: 1 of 2, 50 %" in said.err) == bool(flag)
    assert ("DEBUG epipole.anything: thought" in said.err) == bool(flag)
    assert not logging.getLogger("epipole").handlers


def test_long_lines_stay_whole_in_a_file_and_help_stays_narrow(capsys, monkeypatch):
    from rich.console import Console

    def wide(out: str) -> None:
        """Say it."""
        Console().print(out)

    monkeypatch.delenv("COLUMNS", raising=False)
    monkeypatch.setattr(command_line, "_functions", lambda: {"wide": wide, "silent": speaking})
    path = "/".join(["some folder"] * 30)
    main(["wide", "--out", path])
    assert capsys.readouterr().out == path + "\n"
    assert "COLUMNS" not in command_line.os.environ
    with pytest.raises(SystemExit):
        main(["--help"])
    assert max(map(len, capsys.readouterr().out.splitlines())) < 250


def test_a_quiet_command_still_answers_and_still_fails(capsys, monkeypatch):
    monkeypatch.setattr(command_line, "_functions", lambda: {"speaking": speaking, "silent": speaking})
    monkeypatch.setattr(command_line, "ANSWERING", ("speaking",))
    main(["-q", "speaking", "--out", "x"])
    said = capsys.readouterr()
    assert said.out == "said x False\n" and said.err == ""
    monkeypatch.undo()
    assert refused("-q reconstruct nothing/here out", capsys, 1) == "nothing/here does not exist"


def test_verbose_says_where_an_error_comes_from(capsys):
    with pytest.raises(SystemExit):
        main(["-v", "reconstruct", "nothing/here", "out"])
    said = capsys.readouterr().err
    assert "sfm/run.py" in said and said.endswith("epipole: nothing/here does not exist\n")


def test_files_that_the_system_refuses_are_one_line(capsys, tmp_path):
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    for path, code in ((loop, 2), ("x" * 5000, 1)):
        with pytest.raises(SystemExit) as stopped:
            main(["stereo", str(path), str(path), str(tmp_path / "out")])
        assert stopped.value.code == code
        said = capsys.readouterr().err
        assert said.splitlines()[-1].startswith("epipole: ") and "Traceback" not in said


@pytest.mark.parametrize(("given", "words"), [("help", "stereo doctor"), ("help convert", "SOURCE TARGET")])
def test_help_as_a_command(given, words, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(given.split())
    assert stopped.value.code == 0 and words in capsys.readouterr().out


@pytest.mark.parametrize("command", ["view", "undistort", "evaluate --truth .", "convert x --format ply"])
def test_a_folder_that_is_not_there(command, capsys, tmp_path):
    name, *rest = command.split()
    said = refused(" ".join([name, str(tmp_path / "nothing"), *rest]), capsys, 1)
    assert "nothing: it does not exist" in said
