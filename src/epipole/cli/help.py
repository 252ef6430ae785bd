"""Help of a command: a first screen with what people use most, and `--help-all` with every option in groups."""

from __future__ import annotations

import contextlib
import io
import os
import re
import shutil
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

from epipole.cli.first_screens import FIRST_SCREENS, GROUPS, FirstScreen
from epipole.cli.value_names import with_value_name

ALL = "--help-all"
WIDEST, NAME_WIDTH = 100, 30


@dataclass(frozen=True, slots=True)
class Entry:
    """An argument or option."""

    name: str
    """Option and value: `--max-frames INT`."""
    text: str
    negation: str = ""
    """Of a flag: the option that switches it off."""

    @property
    def option(self) -> str:
        """The option without its value."""
        return self.name.split()[0]


EVERYWHERE = (
    Entry("-q, --quiet", "Print only errors, and the results of commands such as evaluate."),
    Entry("-v, --verbose", "Print each unit of work with its time, and tracebacks of errors."),
    Entry("--overwrite", "Replace files that epipole otherwise protects."),
    Entry("-V, --version", "Print the version."),
)


@dataclass(frozen=True, slots=True)
class Help:
    """Help of one command, as the parser has it."""

    summary: str
    """First paragraph."""
    details: str
    """The other paragraphs."""
    arguments: list[Entry]
    groups: dict[str, list[Entry]]
    """Options by title."""


def is_asked_for(words: list[str], commands: Iterable[str]) -> bool:
    """Whether the words ask for the help of a command."""
    return words[:1] != [] and words[0] in commands and bool({"-h", "--help", ALL} & set(words))


def command_list(functions: Mapping[str, Callable[..., None]]) -> str:
    """Text of `epipole --help`.

    Args:
        functions: function of every command, by the command's name.
    """
    width = min(shutil.get_terminal_size().columns, WIDEST)
    commands = []
    for name, function in functions.items():
        summary = re.split(r"[;.:](?:\s|$)", function.__doc__ or "", maxsplit=1)[0]
        commands.append(Entry(_spelled(name), " ".join(summary.split())))
    return "\n\n".join(
        [
            "usage: epipole COMMAND [options]",
            "Turn photographs and videos into camera poses, depth, trajectories and 3D models.",
            _section("commands", commands, width),
            _section("options of all commands", EVERYWHERE, width),
            "Help of one command: epipole COMMAND --help",
        ]
    )


def help_text(command: str, print_help: Callable[[], object], *, is_whole: bool) -> str:
    """Text of a command's help.

    Args:
        command: name of the command.
        print_help: prints the parser's own help.
        is_whole: all options, not only the first screen.
    """
    printed = _printed(print_help)
    found = parsed(printed)
    if not (found.arguments or found.groups):
        return printed.strip()  # another version of the parser prints another layout
    width = min(shutil.get_terminal_size().columns, WIDEST)
    first = FIRST_SCREENS.get(command, FirstScreen(()))
    options = first.options.split()
    spelled = _spelled(command)
    arguments = "".join(f" {entry.name}" for entry in found.arguments)
    end = " [options]" if found.groups else ""
    parts = [f"usage: epipole {spelled}{arguments}{end}", textwrap.fill(found.summary, width)]
    if found.details and (is_whole or not options):
        parts += [textwrap.fill(paragraph, width) for paragraph in found.details.split("\n")]
    if first.examples:
        parts.append("\n".join(["examples:", *(f"  {example}" for example in first.examples)]))
    if found.arguments:
        parts.append(_section("arguments", found.arguments, width))
    if is_whole:
        parts += [_section(title, entries, width) for title, entries in _grouped(found.groups).items()]
        return "\n\n".join(parts)
    every = [entry for entries in found.groups.values() for entry in entries]
    shown = [entry for option in options for entry in every if entry.option == option]
    if shown:
        parts.append(_section("options", shown, width))
    if len(every) > len(shown):
        parts.append(f"All {len(every)} options: epipole {spelled} {ALL}")
    return "\n\n".join(parts)


def _spelled(command: str) -> str:
    return command.replace("stereo-doctor", "stereo doctor")


def _printed(print_help: Callable[[], object]) -> str:
    """The parser's help with one line per paragraph."""
    before, said = os.environ.get("COLUMNS"), io.StringIO()
    os.environ["COLUMNS"] = "1000"
    try:
        with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
            print_help()
    finally:
        os.environ.pop("COLUMNS")
        if before is not None:
            os.environ["COLUMNS"] = before
    return said.getvalue()


def parsed(printed: str) -> Help:
    """Sections of the parser's help: a usage line, paragraphs, and underlined titles of options with their descriptions."""
    paragraphs: list[str] = []
    arguments: list[Entry] = []
    groups: dict[str, list[Entry]] = {}
    entries: list[Entry] | None = None
    lines = _one_below_the_other([line.rstrip() for line in printed.splitlines()[1:]])
    for line, following in zip(lines, [*lines[1:], ""]):
        if _is_rule(following) and re.match(r" \S", line):
            title = line.strip()
            entries = arguments if title == "positional arguments" else groups.setdefault(title, [])
        elif line and not _is_rule(line) and entries is None:
            paragraphs.append(line)
        elif line and not _is_rule(line) and entries is not None:
            _add(entries, line, is_argument=entries is arguments)
    groups = {title: [e for e in entries if e.option != "-h,"] for title, entries in groups.items()}
    return Help(
        "".join(paragraphs[:1]), "\n".join(paragraphs[1:]), arguments, {t: e for t, e in groups.items() if e}
    )


def _one_below_the_other(lines: list[str]) -> list[str]:
    """The parser prints many groups of options side by side: the columns below each other, from the left."""
    rules = [[match.start() - 1 for match in re.finditer("-{9,}", line)] for line in lines]
    starts = max(rules, key=len, default=[])
    if len(starts) < 2:
        return lines
    first = next(k for k, line in enumerate(lines) if _is_rule(line)) - 1  # the title above
    columns = list(zip(starts, [*starts[1:], None]))
    return [*lines[:first], *(line[a:b].rstrip() for a, b in columns for line in lines[first:])]


def _is_rule(line: str) -> bool:
    return "---" in line and not line.strip(" -")


def _add(entries: list[Entry], line: str, *, is_argument: bool) -> None:
    """Add a line: an option starts after two spaces, its description is further to the right."""
    start = re.match(r"  (?P<name>\S.*?)(?: {2,}(?P<text>.*))?$", line)
    if start and (is_argument or start["name"].startswith("-")):
        entries.append(_entry(start["name"], start["text"] or ""))
    elif entries and line.startswith("        "):
        last = entries.pop()
        name = f"{last.name}, {last.negation}" if last.negation else last.name
        entries.append(_entry(name, f"{last.text} {line.strip()}".strip()))


def _entry(name: str, text: str) -> Entry:
    """An entry with the names of its values instead of their types, and with the negation of a flag only if that changes the default."""
    name = with_value_name(name)
    flag = re.fullmatch(r"(--[\w.-]+), (--[\w.-]*no-[\w.-]+)", name)
    if not flag:
        is_needed = name.startswith("-") and text.endswith("(required)")
        return Entry(name, f"{_plain_text(text)} Required.".lstrip() if is_needed else _plain_text(text))
    text = text.replace("(default: True)", f"(default: yes; {flag[2]}: no)")
    return Entry(flag[1], _plain_text(text), flag[2])


def _plain_text(text: str) -> str:
    text = re.sub(r" ?\((?:default: (?:None|False|none|'')|required)\)", "", text)
    return re.sub(r"[.;,]? \(?None: ([^()]+?)\)?\.?$", r" (default: \1)", text)


def _grouped(groups: dict[str, list[Entry]]) -> dict[str, list[Entry]]:
    """Options by group; those that are flat in the parser by `GROUPS`."""
    owner = {option: title for title, options in GROUPS.items() for option in options.split()}
    flat = groups.get("options", [])
    out: dict[str, list[Entry]] = {"options": [entry for entry in flat if entry.option not in owner]}
    for entry in flat:
        if entry.option in owner:
            out.setdefault(owner[entry.option], []).append(entry)
    out |= {
        title.removesuffix(" options"): entries for title, entries in groups.items() if title != "options"
    }
    return {title: entries for title, entries in out.items() if entries}


def _section(title: str, entries: Iterable[Entry], width: int) -> str:
    return "\n".join([f"{title}:", *(line for entry in entries for line in _lines(entry, width))])


def _lines(entry: Entry, width: int) -> Iterator[str]:
    """The name, and its description in a second column."""
    indent = " " * NAME_WIDTH
    text = textwrap.wrap(entry.text, max(width - NAME_WIDTH, 30)) or [""]
    if len(entry.name) + 4 > NAME_WIDTH:
        yield f"  {entry.name}"
    else:
        yield f"  {entry.name}".ljust(NAME_WIDTH) + text.pop(0)
    yield from (indent + line for line in text)
