"""Explain a wrong command line in one sentence."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches

from epipole.cli.options import Option, Signature

_BOX = "╭╮╰╯─│ "


def explain(words: Sequence[str], signatures: Mapping[str, Signature]) -> str | None:
    """The first mistake in the words after the program's name; None if none is found.

    Args:
        words: command and arguments.
        signatures: signature of every command, by name.
    """
    if not words:
        return f"no command given. One of {', '.join(signatures)}; see `epipole --help`"
    command, *rest = words
    if command not in signatures:
        kind = "option" if command.startswith("-") else "command"
        near = _similar(command, signatures)
        return f"unknown {kind} {command} (the commands are {', '.join(signatures)}){near}"
    mine = signatures[command]
    paths: list[str] = []
    given: set[str] = set()
    taken: list[str] = []
    problem, k = None, 0
    while k < len(rest) and problem is None:
        if not _is_option(rest[k]):
            paths.append(rest[k])
            k += 1
            continue
        problem, used = _option_at(rest[k:], mine, signatures)
        given.add(_named(rest[k])[0])
        if used > 2:
            taken.append(" ".join(rest[k : k + used]))
        k += used
    problem = (
        problem
        or _missing_path(paths, mine, taken)
        or _missing_option(given, mine)
        or _extra_path(paths, mine)
    )
    if problem is None or problem.endswith("?"):
        return problem
    return f"{problem}; see `epipole {command} --help`"


def with_option_names(message: str, words: Sequence[str], signature: Signature, *, also_plain: bool) -> str:
    """Replace config fields in a message by the options, spelled as the user gave them.

    Args:
        message: message of a config.
        words: command line.
        signature: signature of the command.
        also_plain: also replace fields whose names are English words, such as `rows`, if their option was given;
            otherwise only at the start of the message.
    """
    given = {_named(word)[0] for word in words if _is_option(word)}

    def option(found: re.Match[str]) -> str:
        named = [each.name for each in signature.of_field(found[0])]
        mine = [name for name in named if name in given]
        if "_" not in found[0] and not also_plain and found.start() > 0:
            return found[0]
        if not mine and "_" in found[0] and len(named) == 1:
            mine = named
        return mine[0] if mine else found[0]

    named = re.sub(r"(?<![\w./-])[a-z]\w*(?![\w/-]|\.\w)", option, message)
    return _with_neighbours(named, signature)


def _with_neighbours(message: str, signature: Signature) -> str:
    """Also replace fields listed together with an option, as in `--include and exclude`."""

    def option(found: re.Match[str]) -> str:
        named = signature.of_field(found["field"])
        return found[0].replace(found["field"], named[0].name) if len(named) == 1 else found[0]

    between, field, given = r"(?:,? and |,? or |, )", r"(?P<field>[a-z]\w*)", r"--[a-z][\w.-]*"
    message = re.sub(rf"{given}{between}{field}(?![\w.-])", option, message)
    return re.sub(rf"(?<![\w.-]){field}{between}{given}", option, message)


def unboxed(text: str) -> str:
    """The parser's message without the box around it."""
    lines = [line.strip(_BOX) for line in text.splitlines()]
    kept = [line for line in lines if line and not line.startswith("For full helptext")]
    return " ".join(kept) or "the arguments cannot be understood; see `epipole --help`"


def _option_at(
    rest: Sequence[str], mine: Signature, signatures: Mapping[str, Signature]
) -> tuple[str | None, int]:
    """What is wrong with the first option, and how many words belong to it."""
    name, value = _named(rest[0])
    option = mine.options.get(name) or _negated(name, mine)
    if option is None:
        return _unknown(name, mine, signatures), 1
    values = [value] if value is not None else []
    for word in rest[1 : 1 + option.num_values - len(values)]:
        if word.startswith("--"):
            break
        values.append(word)
    used = 1 + len(values) - (value is not None)
    wrong = [word for word in values if not option.accepts(word)]
    if len(values) < option.num_values:
        got = f", got {' '.join(values)}" if values else ""
        return f"{name} needs {option.allowed}{got}", used
    if option.kind is bool and value is not None:
        return f"{name} takes no value, got {value!r}", used
    if wrong:
        near = _similar(wrong[0], option.allowed.removeprefix("one of ").split(", "))
        return f"{name} must be {option.allowed}; got {' '.join(values)!r}{near}", used
    return None, used


def _unknown(name: str, mine: Signature, signatures: Mapping[str, Signature]) -> str:
    start = f"`epipole {mine.command}` has no option {name}"
    tails = {option: option.rsplit(".", 1)[-1].lstrip("-") for option in mine.options}
    tail = name.rsplit(".", 1)[-1].lstrip("-")
    same = [option for option, its in tails.items() if its == tail]
    if same:
        return f"{start}; did you mean {' or '.join(same[:3])}?"
    others = [command for command, other in signatures.items() if name in other.options]
    if others:
        return f"{start}; it is one of {' and '.join(f'`epipole {c}`' for c in others)}"
    near = [option for option, its in tails.items() if get_close_matches(tail, [its], 1, 0.75)]
    group = name.rsplit(".", 1)[0] + "."
    inside = {its: option for option, its in tails.items() if option.startswith(group)}
    near += [inside[its] for its in get_close_matches(tail, inside, 1, 0.5)]
    names = list(dict.fromkeys(near))[:3]
    return f"{start}; did you mean {' or '.join(names)}?" if names else start


def _extra_path(paths: Sequence[str], mine: Signature) -> str | None:
    if len(paths) <= len(mine.paths):
        return None
    extra, wanted = paths[len(mine.paths)], _wanted(mine)
    if not wanted:
        return f"`epipole {mine.command}` takes no path, got {extra!r}"
    return f"`epipole {mine.command}` takes only {wanted}; {extra!r} is unexpected (quote names with spaces)"


def _missing_path(paths: Sequence[str], mine: Signature, taken: Sequence[str]) -> str | None:
    """The missing paths, and an option that may have taken them as its values."""
    missing = [name for name, is_required in mine.paths[len(paths) :] if is_required]
    if not missing:
        return None
    are = "is" if len(missing) == 1 else "are"
    by = f" (`{taken[-1]}` is one option with its values)" if taken else ""
    return f"`epipole {mine.command}` needs {_wanted(mine)}; {' and '.join(missing)} {are} missing{by}"


def _wanted(mine: Signature) -> str:
    return " ".join(name for name, _ in mine.paths)


def _missing_option(given: set[str], mine: Signature) -> str | None:
    missing = [o for o in mine.options.values() if o.is_required and o.name not in given]
    if not missing:
        return None
    return f"`epipole {mine.command}` needs {missing[0].name} with {missing[0].allowed}"


def _similar(word: str, known: Sequence[str] | Mapping[str, Signature]) -> str:
    near = get_close_matches(word.lower(), list(known), 1, 0.6)
    return f"; did you mean {near[0]}?" if near else ""


def _named(word: str) -> tuple[str, str | None]:
    """Name of an option with dashes, as the parser reads it, and the value after `=`."""
    name, _, value = word.partition("=")
    return name.replace("_", "-"), value if "=" in word else None


def _negated(name: str, mine: Signature) -> Option | None:
    """The flag that `--no-flag` turns off."""
    head, _, tail = name.rpartition("no-")
    flag = mine.options.get(head + tail)
    return flag if flag is not None and flag.kind is bool else None


def _is_option(word: str) -> bool:
    return word.startswith("-") and len(word) > 1 and not re.fullmatch(r"-\.?\d.*", word)
