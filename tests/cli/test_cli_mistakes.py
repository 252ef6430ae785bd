"""Wrong usage is one sentence, in the user's own spelling, and exit code 2; options that every command takes."""

import dataclasses
import logging
import re
import sys

import pytest

from epipole import screen
from epipole.cli import main as command_line
from epipole.cli.main import COMMANDS, _functions, main
from epipole.cli.mistakes import explain, unboxed, with_option_names
from epipole.cli.options import signature_of
from epipole.pipelines.sfm.config import ReconstructConfig

SIGNATURES = {name: signature_of(name, function) for name, function in _functions().items()}


def refused(given: str, capsys: pytest.CaptureFixture, code: int = 2) -> str:
    with pytest.raises(SystemExit) as stopped:
        main(given.split())
    said = capsys.readouterr()
    assert stopped.value.code == code and said.out == ""
    assert said.err.startswith("epipole: ") and said.err.count("\n") == 1
    assert not any(word in said.err for word in ("tyro", "dummy", "Traceback", "╭", "│"))
    return said.err.removeprefix("epipole: ").rstrip()


@pytest.mark.parametrize(
    ("given", "parts"),
    [
        ("", ["no command given", "reconstruct, slam, splat, nerf, render, mesh, compare-fields, stereo"]),
        ("reconstrut a b", ["unknown command reconstrut", "did you mean reconstruct?"]),
        ("a b reconstruct", ["unknown command a"]),
        ("--nosuch", ["unknown option --nosuch"]),
        ("reconstruct", ["IMAGES and OUT are missing"]),
        ("reconstruct a", ["needs IMAGES OUT; OUT is missing"]),
        ("reconstruct a b c", ["takes only IMAGES OUT", "'c'"]),
        ("version a", ["takes no path", "'a'"]),
        ("reconstruct a b --mapper.nosuch 1", ["no option --mapper.nosuch; see"]),
        ("reconstruct a b --pairing.mode x", ["--pairing.mode; did you mean --pairing.method?"]),
        ("reconstruct a b --max-features 9", ["--max-features; did you mean --features.max-features?"]),
        ("reconstruct a b --feature.max_features 9", ["did you mean --features.max-features?"]),
        ("reconstruct a b --sinle-camera", ["did you mean --single-camera?"]),
        ("reconstruct a b --columns 0", ["no option --columns; it is one of `epipole calibrate`"]),
        ("reconstruct a b -x", ["no option -x"]),
        (
            "reconstruct a b --pairing.method sequental",
            ["one of auto, exhaustive", "did you mean sequential?"],
        ),
        ("reconstruct a b --features.max-features abc", ["--features.max-features must be a whole number"]),
        ("reconstruct a b --features.max-features 1.5", ["must be a whole number; got '1.5'"]),
        ("reconstruct a b --features.max-features", ["--features.max-features needs a whole number"]),
        ("reconstruct a b --threads two", ["--threads must be a whole number, or None; got 'two'"]),
        ("reconstruct a b --single-camera=yes", ["--single-camera takes no value, got 'yes'"]),
        ("stereo a b c --window 5", ["--window needs 2 whole numbers, got 5"]),
        ("stereo a b c --window 5 x", ["--window must be 2 whole numbers; got '5 x'"]),
        ("stereo a b c --window --strict", ["--window needs 2 whole numbers"]),
        ("stereo a b c --calibration", ["--calibration needs a path"]),
        ("stereo a b c --paths 5", ["--paths must be one of 4, 8; got '5'"]),
        ("evaluate a", ["needs --truth with a path"]),
        ("convert a b", ["b tells no format", "one of txt, bin, ply, transforms, bundler, splat"]),
        ("convert a b txt", ["takes only SOURCE TARGET", "'txt' is unexpected"]),
        ("convert a b --format obj", ["--format must be one of txt", "got 'obj'"]),
        ("calibrate a b --square", ["--square needs a number"]),
        ("view a --port 8x", ["--port must be a whole number, or None; got '8x'"]),
        ("--quiet --verbose version", ["exclude each other"]),
    ],
)
def test_wrong_words(given, parts, capsys):
    said = refused(given, capsys)
    assert all(part in said for part in parts), said


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
        ("stereo a b c --window 4 5", "--window must have odd sides and at most 121 pixels, is (4, 5)"),
    ],
)
def test_values_that_a_config_refuses_name_the_option_as_it_was_given(given, said, capsys):
    assert refused(given, capsys) == said


def test_a_config_of_a_run_names_options_too_but_leaves_words_alone(capsys):
    assert refused("stereo a b --paths 4", capsys) == "`epipole stereo` needs LEFT RIGHT OUT, got a b"


def test_a_field_beside_an_option_is_written_as_one():
    words, signature = ["reconstruct", "a", "b", "--include", "*"], SIGNATURES["reconstruct"]
    message = "include and exclude select images of a folder, but x.mp4 is a video"
    said = with_option_names(message, words, signature, also_plain=False)
    assert said == "--include and --exclude select images of a folder, but x.mp4 is a video"


def test_an_option_that_took_a_path_for_its_value_is_shown(capsys):
    said = refused("stereo --workspace W --pair A OUT", capsys)
    assert "LEFT is missing (`--pair A OUT` is one option with its values)" in said


def test_what_is_read_off_the_signatures_is_what_the_parser_takes(capsys):
    """Every option that the explanations know is one of the command's help, with its default."""
    assert len(SIGNATURES) == len(COMMANDS)
    for name, signature in SIGNATURES.items():
        with pytest.raises(SystemExit) as stopped:
            main([name, "--help"])
        printed = capsys.readouterr().out
        assert stopped.value.code == 0
        assert set(signature.options) <= set(re.findall(r"--[\w.-]+", printed)), name
        assert all(path in printed for path, _ in signature.paths)
    fields = {f.name for f in dataclasses.fields(ReconstructConfig)}
    assert {"threads", "masks"} <= fields & {o.field for o in SIGNATURES["reconstruct"].options.values()}


@pytest.mark.parametrize(
    "given",
    [
        "reconstruct a b --no-single-camera --masks m --camera-params=1,2 --mapper.refine-focal",
        "stereo a b c --min-disparity-px -5 --window 7 7 --calibration x --calibration y --max-sigma-px None",
        "stereo --workspace w --pair a b o",
        "calibrate a b --columns 9 --refine_warp --right r",
        "demo",
    ],
)
def test_nothing_is_wrong_with_right_words(given):
    assert explain(given.split(), SIGNATURES) is None


def test_what_the_parser_says_is_kept_where_nothing_better_is_known(monkeypatch, capsys):
    monkeypatch.setattr("epipole.cli.mistakes.explain", lambda *_: None)
    assert "--nosuch" in refused("version --nosuch", capsys)
    assert unboxed("╭─ A ─╮\n│ b  │\n│ ── │\n│ For full helptext, x │\n╰─╯") == "A b"


def test_help_of_stereo_says_when_its_paths_are_needed(capsys):
    with pytest.raises(SystemExit):
        main(["stereo", "--help"])
    printed = " ".join(capsys.readouterr().out.replace("│", " ").split())
    positional = printed[: printed.index("--strict")]
    assert "default: None" not in positional
    assert positional.count("(required, except with --workspace)") == 2


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
    assert "Doing: begins, 2 to do" in said.err and "Doing: 2 of 2 after" in said.err
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


@pytest.mark.parametrize(("given", "words"), [("help", "stereo-doctor"), ("help convert", "SOURCE TARGET")])
def test_help_as_a_command(given, words, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(given.split())
    assert stopped.value.code == 0 and words in capsys.readouterr().out


@pytest.mark.parametrize("command", ["view", "undistort", "evaluate --truth .", "convert x --format ply"])
def test_a_folder_that_is_not_there(command, capsys, tmp_path):
    name, *rest = command.split()
    said = refused(" ".join([name, str(tmp_path / "nothing"), *rest]), capsys, 1)
    assert "nothing: there is no such f" in said
