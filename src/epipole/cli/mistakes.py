"""Explain a wrong command line in one sentence: the parser's message without its box, with option names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches

from epipole.cli.value_names import value_names

OTHER_NAMES = {
    "share": "view PATH --share FILE",
    "export": "convert",
    "train": "splat",
    "sfm": "reconstruct",
    "mapper": "reconstruct",
    "automatic_reconstructor": "reconstruct",
    "depth": "stereo",
    "doctor": "stereo doctor",
    "viewer": "view",
    "gui": "view",
    "odometry": "slam",
    "track": "slam",
    "gsplat": "splat",
}
"""What other programs call a command, or an option of one."""
_BOX = "╭╮╰╯─│- "


def in_one_sentence(said: str, words: Sequence[str], required: Sequence[str] = ()) -> str:
    """The parser's message, with similar options or a pointer to the command's help.

    Args:
        said: output of the parser: a title, the message, and sections with similar options.
        words: command line.
        required: names of the command's required arguments.
    """
    command = words[0]
    sections: list[list[str]] = [[]]
    for line in said.strip().splitlines()[1:]:  # below the title
        words_of_line = line.strip(" │")
        if words_of_line.strip(_BOX):
            sections[-1].append(words_of_line)
        elif sections[-1]:
            sections.append([])
    if required and "".join(sections[0][:1]).startswith("Missing from"):
        given = " ".join(words[1:]) or "nothing"
        return f"`epipole {command}` needs {' '.join(required)}, got {given}; see `epipole {command} --help`"
    text = " ".join(sections[0]) or "the arguments cannot be understood"
    text = _in_plain_words(text.rstrip("."), words, required)
    near = _similar(sections, command)
    if "; did you mean" in text:
        return text
    end = f"; did you mean {' or '.join(near)}?" if near else f"; see `epipole {command} --help`"
    return text + end


def _in_plain_words(text: str, words: Sequence[str], required: Sequence[str]) -> str:
    """The parser's message in plain words: which option, what it takes, and what it got."""
    if found := re.match(r"Missing value for argument '(\S+)'\. Expected (\d+) values", text):
        count = int(found[2])
        names = value_names(found[1], count)
        needs = "a value" if count == 1 else f"{count} values"
        return f"{found[1]} needs {needs}{f': {names}' if names else ''}"
    if found := re.match(r"invalid choice '(.*)' for argument '(\S+)'\. Expected one of \((.*)\)", text):
        return _wrong_choice(found[2], found[1], re.findall(r"'([^']*)'", found[3]))
    if found := re.match(r"Error parsing (\S+): (.*)", text):
        return _wrong_value(found[1], found[2], words)
    if found := re.match(r"Unrecognized (?:or misplaced )?options: (.*)", text):
        unknown = re.sub(r" \(applied to [^)]*\)", ",", found[1]).strip(", ").split(", ")
        options = [word for word in unknown if word.startswith("-")]
        if options:
            return f"unknown option{'s' if len(options) > 1 else ''} {' and '.join(options)}"
        takes = f": `epipole {words[0]}` takes only {' '.join(required)}" if required else ""
        return f"unexpected argument{'s' if len(unknown) > 1 else ''} {' '.join(unknown)}{takes}"
    return text


def _wrong_choice(option: str, given: str, choices: Sequence[str]) -> str:
    known = [choice for choice in choices if choice != "None"]
    if len(known) < len(choices):  # the parser has the choices of an optional value in no fixed order
        known.sort()
    near = get_close_matches(given, known, 1, 0.6)
    listed = f"{', '.join(known[:-1])} or {known[-1]}" if len(known) > 1 else "".join(known)
    return f"{option} must be {listed}, got {given}" + (f"; did you mean {near[0]}?" if near else "")


def _wrong_value(option: str, why: str, words: Sequence[str]) -> str:
    """A value that is no number, or none of its option's type."""
    given = _given_to(option, words)
    noun = "whole number" if re.search(r"\bINT\b|\bint\b", why) else "number"
    if not re.search(r"\b(INT|FLOAT|int|float)\b", why):
        return f"{option} cannot be {' '.join(given) or 'empty'}"
    names = value_names(option, len(given))
    needs = f"a {noun}" if len(given) < 2 else f"{len(given)} {noun}s{f' ({names})' if names else ''}"
    return f"{option} must be {needs}, got {' '.join(given) or 'nothing'}"


def _given_to(option: str, words: Sequence[str]) -> list[str]:
    """Values that the command line gives to an option."""
    for k, word in enumerate(words):
        name, equals, value = word.partition("=")
        if name.replace("_", "-") == option:
            after = list(words[k + 1 :])
            stop = next((n for n, other in enumerate(after) if other.startswith("--")), len(after))
            return [part for part in [value] if part] if equals else after[:stop]
    return []


def unknown_command(command: str, commands: Sequence[str]) -> str:
    """What to call instead of a command that does not exist."""
    near = get_close_matches(command.lower(), commands, 1, 0.6)
    meant = OTHER_NAMES.get(command.lower()) or (near[0].replace("stereo-", "stereo ") if near else "")
    hint = f"; did you mean `epipole {meant}`?" if meant else ";"
    return f"unknown command {command}{hint} `epipole --help` lists all commands"


def _similar(sections: Sequence[Sequence[str]], command: str) -> list[str]:
    """Similar options of this command, as found by the parser."""
    found, option = [], ""
    for line in (line for part in sections for line in part):
        if line.startswith("--"):
            option = line.split()[0].rstrip(",")
        elif line == f"in epipole {command} --help" and option not in found:
            found.append(option)
    return found[:3]


def with_option_names(
    message: str, words: Sequence[str], options: Mapping[str, str], *, also_plain: bool
) -> str:
    """Replace config fields in a message by the options, spelled as the user gave them.

    Args:
        message: message of a config.
        words: command line.
        options: options of the command, each with its field.
        also_plain: also replace fields whose names are English words, such as `rows`, if their option was given;
            otherwise only at the start of the message.
    """
    given = {word.partition("=")[0].replace("_", "-") for word in words if word.startswith("-")}

    def option(found: re.Match[str]) -> str:
        named = [name for name, field in options.items() if field == found[0]]
        mine = [name for name in named if name in given]
        if "_" not in found[0] and not also_plain and found.start() > 0:
            return found[0]
        if not mine and "_" in found[0] and len(named) == 1:
            mine = named
        return mine[0] if mine else found[0]

    named = re.sub(r"(?<![\w./-])[a-z]\w*(?![\w/-]|\.\w)", option, _with_requests(message, options))
    return _with_neighbors(named, options)


def _with_requests(message: str, options: Mapping[str, str]) -> str:
    """Replace fields that the message asks for, as in `pass map`, `(option cameras)`, `steps=` or `path=orbit`."""

    def option(found: re.Match[str]) -> str:
        named = [name for name, field in options.items() if field == found["field"]]
        if len(named) != 1:
            return found[0]
        return f"{found['before']}{named[0]}{found['after'] and ' '}{found['after']}"

    field, end = r"(?P<field>[a-z]\w*)", r"(?P<after>)(?=[.,;:)]|$)(?!\.\w)"
    message = re.sub(rf"(?P<before>\b(?:pass|give|leave out|without) ){field}{end}", option, message)
    message = re.sub(rf"(?P<before>\()option {field}{end}", option, message)
    message = re.sub(rf"(?P<before>(?<![\w.-])){field}=True\b(?P<after>)", option, message)
    message = re.sub(rf"(?P<before>(?<![\w.-])){field}=(?P<after>)(?=[.,;:)]|$| )", option, message)
    return re.sub(rf"(?P<before>(?<![\w.-])){field}=(?P<after>[a-z_]+\b)(?![\w.(-])", option, message)


def _with_neighbors(message: str, options: Mapping[str, str]) -> str:
    """Also replace fields listed together with an option, as in `--include and exclude`."""

    def option(found: re.Match[str]) -> str:
        named = [name for name, field in options.items() if field == found["field"]]
        return found[0].replace(found["field"], named[0]) if len(named) == 1 else found[0]

    between, field, given = r"(?:,? and |,? or |, )", r"(?P<field>[a-z]\w*)", r"--[a-z][\w.-]*"
    message = re.sub(rf"{given}{between}{field}(?![\w.-])", option, message)
    return re.sub(rf"(?<![\w.-]){field}{between}{given}", option, message)
