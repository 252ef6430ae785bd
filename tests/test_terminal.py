"""Names reach the terminal as text, whatever bytes they are of: on a terminal, in a file, as an error, in a table."""

import io
import json
import logging
import os
import pty
import re
import subprocess
import sys
import unicodedata
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from architecture.architecture_sources import sources
from epipole import screen
from epipole._terminal import one_line, say, terminal_text
from epipole.runs import Progress
from whole import IS_WHOLE

HOSTILE = "a\x1b[2J\x1b]0;title\x07\x9b31m\u202egnp.exe\r\x08\x7f[red]x[/blue]"
ACTING = set("\x1b\x07\x9b\u202e\x08\x7f")
OF_SPINNER = re.compile(r"\x1b\[(0m|32m|\?25[lh]|1A|2K)")
"""The color and the moves of the cursor that Rich's spinner needs; none is in HOSTILE."""


@given(st.text())
def test_nothing_acts_on_a_terminal(text: str) -> None:
    for shown in (terminal_text(text), one_line(text)):
        for mark in shown:
            assert mark in "\t\n" or unicodedata.category(mark) not in ("Cc", "Cs")
            assert unicodedata.bidirectional(mark) not in (
                "LRE",
                "RLE",
                "PDF",
                "LRO",
                "RLO",
                "LRI",
                "RLI",
                "FSI",
                "PDI",
            )
        shown.encode()
    assert not set(one_line(text)) & {"\t", "\n"}


@pytest.mark.parametrize("text", ["Ünïcødé 文件 名前.jpg", "ملف.png", "a b\tc", r"C:\x1b", "👩‍🔬.png"])
def test_honest_names_stay(text: str) -> None:
    assert terminal_text(text) == text


def test_what_acts_is_written_out() -> None:
    assert terminal_text("\x1b[0m\x9b\u202e\udcff") == r"\x1b[0m\x9b\u202e\udcff"
    assert terminal_text("a\r\n") == "a\\r\n" and one_line("a\tb\n") == r"a\tb\n"


@pytest.mark.parametrize("is_terminal", [True, False])
def test_consoles_show_names_as_text(is_terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    from rich.table import Table
    from rich.text import Text

    stream = io.StringIO()
    monkeypatch.setattr("sys.stdout", stream)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("FORCE_COLOR", "1") if is_terminal else monkeypatch.delenv(
        "FORCE_COLOR", raising=False
    )
    console = screen.open_console()
    table = Table(HOSTILE, box=None)
    table.add_row(HOSTILE)
    for shown in (HOSTILE, table, Text(HOSTILE)):
        console.print(shown, style="yellow", highlight=False)
    screen.print_warnings(console, [f"{HOSTILE}\nepipole: all is well"])
    plain = (
        stream.getvalue()
        .replace("\x1b[33m", "")
        .replace("\x1b[1;33m", "")
        .replace("\x1b[0m", "")
        .replace("\x1b[1m", "")
    )
    assert not set(plain) & ACTING and "[red]x[/blue]" in plain and r"\x1b[2J" in plain
    assert "\nepipole: all is well" not in plain
    assert ("\x1b[33m" in stream.getvalue()) == is_terminal


def test_lines_logs_and_progress_show_names_as_text(capsys: pytest.CaptureFixture[str]) -> None:
    say(HOSTILE)
    say(HOSTILE, to_stderr=True)
    with screen.loudness("verbose"):
        logging.getLogger("epipole.test").debug("unit %s", HOSTILE)
        with screen.progress_on_screen({"s": "Stage"}) as progress:
            progress(Progress("s", 0, 2, HOSTILE))
            progress(Progress("s", 2, 2, HOSTILE))
    said = capsys.readouterr()
    assert said.err.count(r"\u202egnp") >= 3 and not set(said.out + said.err) & ACTING


def on_a_terminal(words: list[str], folder: Path) -> str:
    main, side = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "epipole", *words],
        cwd=folder,
        stdin=side,
        stdout=side,
        stderr=side,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "400"},
    )
    os.close(side)
    said = b""
    try:
        while block := os.read(main, 4096):
            said += block
    except OSError:  # the other end is closed
        pass
    process.wait(timeout=60)
    os.close(main)
    return said.decode(errors="surrogateescape")


@pytest.mark.skipif(os.name == "nt", reason="no such names and terminals on Windows")
def test_commands_on_a_terminal(tmp_path: Path) -> None:
    name = HOSTILE.replace("/", "")
    (tmp_path / name).mkdir()
    (tmp_path / name / f"{name}.json").write_text(json.dumps({name: name}))
    others = (["view", name], ["convert", name, f"{name}.x"]) if IS_WHOLE else ()
    for words in (["evaluate", name, "--truth", name], [name], *others):
        said = on_a_terminal(words, tmp_path)
        assert "gnp.exe" in said and not set(OF_SPINNER.sub("", said)) & ACTING, words


def test_nobody_prints_otherwise() -> None:
    for source in sources():
        text = source.path.read_text(encoding="utf-8")
        if source.path.name not in ("screen.py", "_terminal.py"):
            assert "rich.console" not in text, source.name
            printed = [line.strip() for line in text.splitlines() if line.strip().startswith("print(")]
            assert all(line.startswith("print(json_text(") for line in printed), source.name
