"""Generates the command reference from the parsers of the command line."""

from __future__ import annotations

import argparse
import re
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import tyro

from epipole.cli import main as command_line
from epipole.cli.value_names import with_value_name

HEAD = """# Command reference

These pages are generated from the command line and match `epipole COMMAND --help`. Paths have a fixed order; options can be anywhere.
Every command accepts `-q`, `--quiet` (print only errors, and the results of commands such as `evaluate`) and `-v`, `--verbose` (print
each unit of work with its time, and tracebacks of errors). Commands that write files accept `--overwrite`, which allows them to replace
files that epipole did not write ([promises](../promises.md)).

| exit code | |
|---|---|
| 0 | success |
| 1 | error, with a one-line message |
| 2 | invalid arguments or options |
| 3 | a `--strict` check failed |
| 130 | stopped by Ctrl-C; finished work is kept |

| command | |
|---|---|
"""


def command_pages() -> dict[str, str]:
    """Markdown by path: an index and one page per command."""
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
    """Positional paths, and (title, description, options) of each group."""
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
    """Markdown table with the name, value, default and meaning of each option."""
    rows = [
        '<div class="options" markdown>',
        "",
        "| option | value | default | meaning |",
        "|---|---|---|---|",
    ]
    for action in actions:
        text, default = _described(action)
        names = ", ".join(f"`{name}`" for name in action.option_strings)
        rows.append(f"| {names} | {_value(action)} | {default} | {_cell(text)} |")
    return "\n".join([*rows, "", "</div>"])


def _value(action: argparse.Action) -> str:
    if action.nargs == 0:
        return ""
    words = with_value_name(f"{action.option_strings[0]} {action.metavar}").partition(" ")[2]
    if words.startswith("{"):
        return ", ".join(f"`{word}`" for word in words.strip("{}").split(",") if word != "None")
    return words


def _described(action: argparse.Action) -> tuple[str, str]:
    """Split the help text into the description and the default."""
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
