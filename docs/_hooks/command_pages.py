"""The command reference, read off the command line's own parser."""

from __future__ import annotations

import argparse
import re
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import tyro

from epipole.cli import main as command_line

HEAD = """# Command reference

Written from the command line itself: `epipole COMMAND --help` says the same. Paths are given in order, options anywhere;
an option that is left out has the default of the table. Every command takes `-q`, `--quiet` (errors alone, and the answer of
commands that give one) and `-v`, `--verbose` (each unit of work, and where an error comes from). Commands that write take
`--overwrite`, which replaces existing files that epipole did not write; without it they are refused ([promises](promises.md)).

| exit code | |
|---|---|
| 0 | done |
| 1 | an error, told in one line |
| 2 | words or options that cannot be used |
| 3 | a check (`--strict`) says no |
| 130 | stopped by Ctrl-C; what was finished is kept |

| command | |
|---|---|
"""


def command_pages() -> dict[str, str]:
    """Markdown by path: one page for each command, and their list."""
    functions = command_line._functions()
    pages = {f"commands/{name}.md": _page(name, function) for name, function in functions.items()}
    rows = [
        f"| [`epipole {_spelled(name)}`]({name}.md) | {_first_line(f)} |" for name, f in functions.items()
    ]
    return {"commands/index.md": HEAD + "\n".join(rows) + "\n", **pages}


def _page(name: str, function: Callable[..., None]) -> str:
    parser = _parser(name, function)
    paths, tables = _tables(parser)
    words = "".join(f" {_placeholder(action)}" for action in paths)
    usage = f"epipole {_spelled(name)}{words}" + (" [OPTIONS]" if tables else "")
    parts = [f"# epipole {_spelled(name)}", _paragraphs(parser.description or ""), f"```text\n{usage}\n```"]
    if paths:
        rows = [f"| `{_placeholder(action)}` | {_cell(_described(action)[0])} |" for action in paths]
        parts.append("\n".join(["| path | |", "|---|---|", *rows]))
    for title, description, actions in tables:
        parts += [f"## {title[0].upper()}{title[1:]}", _paragraphs(description or ""), _table(actions)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _parser(name: str, function: Callable[..., None]) -> argparse.ArgumentParser:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        return tyro.extras.get_parser(
            function, prog=f"epipole {_spelled(name)}", registry=command_line._registry()
        )


def _tables(
    parser: argparse.ArgumentParser,
) -> tuple[list[argparse.Action], list[tuple[str, str | None, list[argparse.Action]]]]:
    """The paths, and the options by their groups."""
    paths: list[argparse.Action] = []
    groups = []
    for group in parser._action_groups:
        actions = [action for action in group._group_actions if action.dest != "help"]
        paths += [action for action in actions if not action.option_strings]
        options = [action for action in actions if action.option_strings]
        if options:
            groups.append((group.title or "options", group.description, options))
    return paths, groups


def _table(actions: list[argparse.Action]) -> str:
    """Name, value, default and meaning of each option."""
    rows = ["| option | value | default | meaning |", "|---|---|---|---|"]
    for action in actions:
        text, default = _described(action)
        names = ", ".join(f"`{name}`" for name in action.option_strings)
        rows.append(f"| {names} | {_value(action)} | {default} | {_cell(text)} |")
    return "\n".join(rows)


def _value(action: argparse.Action) -> str:
    if action.nargs == 0:
        return ""
    words = str(action.metavar)
    if words.startswith("{None}|"):
        words = words.removeprefix("{None}|")
    if words.startswith("{"):
        return ", ".join(f"`{word}`" for word in words.strip("{}").split(",") if word != "None")
    return words


def _described(action: argparse.Action) -> tuple[str, str]:
    """The help without the default at its end, and the default."""
    text = " ".join((action.help or "").replace("%%", "%").split())
    found = re.search(r"\s*\((default: (?P<default>.*)|required[^)]*|repeatable)\)$", text)
    if found is None:
        return text, ""
    rest = text[: found.start()].strip()
    default = found["default"]
    if default is None:
        word = found[0].strip(" ()")
        return rest, "" if not action.option_strings else {"repeatable": "none; repeatable"}.get(word, word)
    if default.lower() == "none":
        return rest, ""
    if action.nargs == 0:
        return rest, {"True": "on", "False": "off"}.get(default, default)
    return rest, f"`{default}`" if default != "''" else "empty"


def _placeholder(action: argparse.Action) -> str:
    word = str(action.metavar)
    return f"[{word}]" if action.nargs == "?" and not word.startswith("[") else word


def _spelled(name: str) -> str:
    return "stereo doctor" if name == "stereo-doctor" else name


def _first_line(function: Callable[..., Any]) -> str:
    return _cell((function.__doc__ or "").strip().splitlines()[0])


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


def _paragraphs(text: str) -> str:
    return "\n\n".join(_joined(text))


def _joined(text: str) -> Iterator[str]:
    for paragraph in text.split("\n\n"):
        yield " ".join(paragraph.split()).replace("<", "&lt;")
