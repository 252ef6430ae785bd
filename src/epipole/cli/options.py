"""Options of a command, and the config fields that they set."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import tyro


def option_names(function: Callable[..., Any]) -> dict[str, str]:
    """Names such as `--features.max-features` of a command's options, each with the name of its field or parameter."""
    hints, found = get_type_hints(function, include_extras=True), dict[str, str]()
    for name in inspect.signature(function).parameters:
        kind, marks = _without_marks(hints[name])
        if is_dataclass(kind):
            found |= _names_in(kind, "", is_flat=tyro.conf.OmitArgPrefixes in marks)
        elif tyro.conf.Positional not in marks:
            found[f"--{_dashed(name)}"] = name
    return found


def required_arguments(function: Callable[..., Any]) -> list[str]:
    """Names such as `SOURCE` or `--truth` of what a command cannot do without, in order.

    Arguments whose default is None are required unless their name is in brackets: `stereo` takes fewer only with --workspace.
    """
    hints, found = get_type_hints(function, include_extras=True), []
    for name, parameter in inspect.signature(function).parameters.items():
        _, marks = _without_marks(hints[name])
        is_required = parameter.default is inspect.Parameter.empty
        if tyro.conf.Positional in marks:
            metavar = next((m.metavar for m in marks if getattr(m, "metavar", None)), name.upper())
            if is_required or (parameter.default is None and not metavar.startswith("[")):
                found.append(metavar)
        elif is_required:
            found.append(f"--{_dashed(name)}")
    return found


def _names_in(config: Any, prefix: str, *, is_flat: bool) -> Iterator[tuple[str, str]]:
    hints = get_type_hints(config, include_extras=True)
    for field in fields(config):
        kind, marks = _without_marks(hints[field.name])
        if is_dataclass(kind):
            is_nameless = is_flat or any(getattr(mark, "name", None) == "" for mark in marks)
            below = prefix if is_nameless else f"{prefix}{_dashed(field.name)}."
            yield from _names_in(kind, below, is_flat=is_flat)
        else:
            yield f"--{prefix}{_dashed(field.name)}", field.name


def _without_marks(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint, getattr(hint, "__metadata__", ())


def _dashed(name: str) -> str:
    return name.replace("_", "-")
