"""Paths and options that a command accepts, derived from its signature."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro

_NUMBERS = {int: "a whole number", float: "a number"}
_WORDS = {**_NUMBERS, Path: "a path"}


@dataclass(frozen=True, slots=True)
class Option:
    """One option of a command, such as `--features.max-features`."""

    name: str
    """Name with leading dashes."""
    field: str
    """Name of the parameter or config field."""
    kind: Any
    """Type without None."""
    takes_none: bool
    is_required: bool

    @property
    def num_values(self) -> int:
        """Number of words after the option."""
        if self.kind is bool:
            return 0
        return len(get_args(self.kind)) if get_origin(self.kind) is tuple and not self.is_repeated else 1

    @property
    def is_repeated(self) -> bool:
        """Whether it may be given several times, with one word each."""
        return get_origin(self.kind) is tuple and get_args(self.kind)[-1] is Ellipsis

    @property
    def allowed(self) -> str:
        """Description of the allowed values."""
        if self.kind is bool:
            return "no value"
        if get_origin(self.kind) is Literal:
            words = "one of " + ", ".join(map(str, get_args(self.kind)))
        elif self.num_values > 1:
            numbers = {int: "whole numbers", float: "numbers"}.get(get_args(self.kind)[0], "words")
            words = f"{self.num_values} {numbers}"
        else:
            words = _WORDS.get(get_args(self.kind)[0] if self.is_repeated else self.kind, "a word")
        return f"{words}, or None" if self.takes_none and self.num_values == 1 else words

    def accepts(self, word: str) -> bool:
        """Whether a word is a valid value."""
        if self.takes_none and word == "None":
            return True
        if get_origin(self.kind) is Literal:
            return word in map(str, get_args(self.kind))
        kind = get_args(self.kind)[0] if get_origin(self.kind) is tuple else self.kind
        try:
            return kind not in _NUMBERS or kind(word) is not None
        except ValueError:
            return False


@dataclass(frozen=True, slots=True)
class Signature:
    """Paths and options of one command."""

    command: str
    paths: tuple[tuple[str, bool], ...]
    """Name in the help, and whether it is required, in order."""
    options: dict[str, Option]
    """Options by name."""

    def of_field(self, field: str) -> list[Option]:
        """Options that set this config field or parameter."""
        return [option for option in self.options.values() if option.field == field]


def signature_of(command: str, function: Callable[..., Any]) -> Signature:
    """Paths and options of a command's function."""
    hints = get_type_hints(function, include_extras=True)
    paths: list[tuple[str, bool]] = []
    options: dict[str, Option] = {}
    for name, parameter in inspect.signature(function).parameters.items():
        kind, marks = _without_marks(hints[name])
        is_required = parameter.default is inspect.Parameter.empty
        if tyro.conf.Positional in marks:
            paths.append((next(m.metavar for m in marks if hasattr(m, "metavar")), is_required))
        elif is_dataclass(kind):
            is_flat = tyro.conf.OmitArgPrefixes in marks
            options |= {option.name: option for option in _options_of(kind, "", is_flat=is_flat)}
        else:
            option = _option("--" + _dashed(name), name, kind, is_required=is_required)
            options[option.name] = option
    return Signature(command, tuple(paths), options)


def _options_of(config: Any, prefix: str, *, is_flat: bool) -> Iterator[Option]:
    hints = get_type_hints(config, include_extras=True)
    for field in fields(config):
        kind, marks = _without_marks(hints[field.name])
        if is_dataclass(kind):
            is_nameless = any(getattr(mark, "name", None) == "" for mark in marks)
            below = prefix if is_flat or is_nameless else f"{prefix}{_dashed(field.name)}."
            yield from _options_of(kind, below, is_flat=is_flat)
        else:
            yield _option(
                f"--{prefix}{_dashed(field.name)}", field.name, kind, is_required=_is_required(field)
            )


def _option(name: str, field: str, kind: Any, *, is_required: bool) -> Option:
    members = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    named = [member for member in members if member is not NoneType]
    return Option(name, field, named[0], len(named) < len(members), is_required)


def _is_required(field: Field[Any]) -> bool:
    return field.default is MISSING and field.default_factory is MISSING


def _without_marks(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint, getattr(hint, "__metadata__", ())


def _dashed(name: str) -> str:
    return name.replace("_", "-")
