"""Help: a first screen with examples and main options, all options on request, and completion scripts."""

import re
import shlex
import sys

import pytest

from epipole.cli import main as command_line
from epipole.cli.first_screens import FIRST_SCREENS, GROUPS
from epipole.cli.help import help_text
from epipole.cli.main import main
from epipole.cli.options import option_names

MOST_LINES, MOST_OPTIONS, WIDTH = 45, 10, 80
COMMANDS = list(command_line._functions())


@pytest.fixture(autouse=True)
def terminal_width(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(WIDTH))


def printed(line: str, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as stopped:
        main(line.split())
    said = capsys.readouterr()
    assert stopped.value.code in (0, None) and not said.err
    return said.out


@pytest.mark.parametrize("name", COMMANDS)
def test_first_screen_is_short_and_plain(name, capsys):
    first, whole = printed(f"{name} --help", capsys), printed(f"{name} --help-all", capsys)
    assert len(first.splitlines()) <= MOST_LINES
    for text in (first, whole):
        assert not re.search(r"\{None|None\}|None:|default: (None|False)|[│╭╰]", text)
        assert max(map(len, text.splitlines())) <= WIDTH
    options = FIRST_SCREENS[name].options.split()
    assert len(options) <= MOST_OPTIONS
    for option in options:
        assert re.search(rf"^  {re.escape(option)}\b", first, re.MULTILINE), option
        described = first[first.index(f"  {option}") :].split("\n  -")[0]
        assert len(described.split()) > 2, option


@pytest.mark.parametrize("name", COMMANDS)
def test_all_options_are_in_the_whole_help(name, capsys):
    shown = set(re.findall(r"^  (--[\w.-]+)", printed(f"{name} --help-all", capsys), re.MULTILINE))
    assert shown == set(option_names(command_line._functions()[name]))


def test_options_have_titles(capsys):
    text = printed("reconstruct --help-all", capsys)
    titles = re.findall(r"^(\S.*):$", text, re.MULTILINE)
    assert titles == [
        "examples",
        "arguments",
        "options",
        "camera",
        "scale",
        "features",
        "matching",
        "pairing",
        "verification",
        "mapper",
    ]


def test_flags_that_are_on_name_their_negation(capsys):
    text = " ".join(printed("reconstruct --help-all", capsys).split())
    assert "(default: yes; --mapper.no-use-gps: no)" in text and "default: True" not in text


def test_stereo_says_when_its_paths_are_required(capsys):
    text = " ".join(printed("stereo --help", capsys).split())
    assert text.count("(required, except with --workspace)") == 2


def test_another_layout_of_the_parser_is_printed_unchanged():
    assert help_text(
        "slam", lambda: sys.stdout.write("usage: other\n\n| --x | y |\n"), is_whole=False
    ).startswith("usage: other")


def test_groups_name_options():
    known = {option for f in command_line._functions().values() for option in option_names(f)}
    grouped = [option for options in GROUPS.values() for option in options.split()]
    assert set(grouped) <= known and len(grouped) == len(set(grouped))


@pytest.mark.parametrize("name", COMMANDS)
def test_examples_are_valid_command_lines(name):
    for example in FIRST_SCREENS[name].examples:
        program, *words = shlex.split(example.partition(" > ")[0])
        words = ["stereo-doctor", *words[2:]] if words[:2] == ["stereo", "doctor"] else words
        assert program == "epipole" and words[0] == name
        assert callable(command_line._parsed(words))


def test_list_of_commands(capsys):
    text = printed("--help", capsys)
    assert len(text.splitlines()) <= MOST_LINES
    for name in COMMANDS:
        assert re.search(rf"^  {name.replace('stereo-doctor', 'stereo doctor')}\b", text, re.MULTILINE)
    assert printed("help slam", capsys) == printed("slam -h", capsys)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts_name_commands_and_options(shell, capsys):
    text = printed(f"completion {shell}", capsys)
    assert "reconstruct" in text and "single-camera" in text
