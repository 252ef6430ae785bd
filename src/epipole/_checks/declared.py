"""Runtime checks of annotations at the public API: arguments and fields are checked, and converted if lossless.

`@checked` checks the arguments of a function, `check_fields` and `Declared` the fields of a data class. Wrong arrays raise
`ShapeError`, everything else `ConfigError`. Kernels then see a single type and layout, so none is compiled twice.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from difflib import get_close_matches
from functools import wraps
from inspect import CO_VARKEYWORDS, Parameter, get_annotations, signature, unwrap
from typing import Any, NamedTuple, TypeVar, cast

from epipole._checks.kinds import Convert, Sizes
from epipole._checks.values import converter_of
from epipole.errors import ArgumentError, ConfigError

_LARGEST_COUNT, _SMALLEST_NUMBER, _LARGEST_NUMBER = 2**31 - 1, 1e-30, 1e30
"""Limits of options: counts go into 32-bit arrays, and numbers are multiplied or squared in single precision."""
Function = TypeVar("Function", bound=Callable[..., Any])
_plans: dict[type, tuple[tuple[str, Convert], ...]] = {}
"""The checked fields of each data class."""


def checked(function: Function) -> Function:
    """Check and convert the arguments of a function according to its annotations; `Any` is not checked.

    Unknown argument names are rejected, with suggestions of similar names.
    """
    own = unwrap(function)
    plan: list[_Parameter] = []

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if not plan:  # annotations are evaluated on first use, to keep imports fast
            plan.extend(_parameters(own))
        if kwargs:
            _refuse_unknown_names(own, kwargs, [each.name for each in plan])
        sizes: Sizes = {}
        given = list(args)
        for index, (name, convert, kind) in enumerate(plan):
            if convert is None:
                continue
            if kind is Parameter.VAR_POSITIONAL:
                given[index:] = [convert(one, f"{name}[{k}]", sizes) for k, one in enumerate(given[index:])]
            elif kind is not Parameter.KEYWORD_ONLY and index < len(given):
                given[index] = convert(given[index], name, sizes)
            elif name in kwargs:
                kwargs[name] = convert(kwargs[name], name, sizes)
        return function(*given, **kwargs)

    return cast(Function, call)


def check_fields(data: Any) -> None:
    """Check and convert the fields of a data class instance according to their annotations; for `__post_init__`."""
    sizes: Sizes = {}
    kind = type(data)
    if kind not in _plans:
        _plans[kind] = _fields(kind)
    for name, convert in _plans[kind]:
        value = getattr(data, name)
        kept = convert(value, name, sizes)
        if kept is not value:
            object.__setattr__(data, name, kept)


def _refuse_unknown_names(function: Callable[..., Any], given: Iterable[str], known: Sequence[str]) -> None:
    takes_any = function.__code__.co_flags & CO_VARKEYWORDS
    for name in () if takes_any else given:
        if name not in known:
            raise ArgumentError(f"{function.__name__} has no argument {name}{did_you_mean(name, known)}")


def did_you_mean(name: str, known: Sequence[str], more: Sequence[str] = ()) -> str:
    """Ending for "there is no NAME": similar names from `known` and `more`, or the list of known names."""
    near = get_close_matches(name, list(dict.fromkeys([*known, *more])), 3, 0.6)
    return f"; did you mean {' or '.join(near)}?" if near else f"; it has {', '.join(known)}"


class _Parameter(NamedTuple):
    """A checked parameter of a function."""

    name: str
    convert: Convert | None
    """None if there is nothing to check."""
    kind: Any


def check_least(data: Any, **least: float) -> None:
    """Check that fields are not below a limit; for `__post_init__`.

    Raises:
        ConfigError: a field is below its limit, or NaN.
    """
    for name, limit in least.items():
        value = getattr(data, name)
        if not value >= limit:
            raise ConfigError(f"{name} must be at least {limit}, got {value:g}")


def check_options(data: Any, *, negative: tuple[str, ...] = (), infinite: tuple[str, ...] = ()) -> None:
    """Check the fields of a config, including the range of its numbers; for `__post_init__`.

    Args:
        data: the instance.
        negative: fields that may be negative.
        infinite: fields that may be infinite.

    Raises:
        ConfigError: a number is negative, infinite, too large or too small, or a field has the wrong type.
        ShapeError: an array has the wrong type or shape.
    """
    check_fields(data)
    for name in data.__dataclass_fields__:
        value = getattr(data, name)
        if isinstance(value, bool) or type(value) not in (int, float):
            continue
        if value < 0 and name not in negative:
            raise ConfigError(f"{name} must not be negative, got {value:g}")
        size = abs(value)
        if type(value) is int:
            if size > _LARGEST_COUNT and "seed" not in name:
                raise ConfigError(f"{name} must be at most {_LARGEST_COUNT}, got {value}")
        elif size == float("inf"):
            if name not in infinite:
                raise ConfigError(f"{name} must be finite, got {value}")
        elif size > _LARGEST_NUMBER or 0 < size < _SMALLEST_NUMBER:
            bounds = f"0, or from {_SMALLEST_NUMBER:g} to {_LARGEST_NUMBER:g}"
            raise ConfigError(f"{name} must be {bounds}, got {value:g}")


def _parameters(function: Callable[..., Any]) -> list[_Parameter]:
    """The converter of every parameter."""
    out: list[_Parameter] = []
    for parameter in signature(function).parameters.values():
        is_named = parameter.kind is Parameter.VAR_KEYWORD
        annotation = Any if is_named else _evaluated(parameter.annotation, function.__globals__)
        out.append(_Parameter(parameter.name, converter_of(annotation), parameter.kind))
    return out


class Declared:
    """Base of array data classes that need no checks besides those of their fields."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            ShapeError: an array has the wrong type or shape.
            ConfigError: another field has the wrong type.
        """
        check_fields(self)


def _fields(kind: type) -> tuple[tuple[str, Convert], ...]:
    """The converters of a data class's fields, those of its bases first."""
    found: dict[str, Convert | None] = {}
    for base in reversed(kind.__mro__):
        names = vars(sys.modules[base.__module__])
        for name, annotation in get_annotations(base).items():
            if name in getattr(kind, "__dataclass_fields__", {}):
                found[name] = converter_of(_evaluated(annotation, names))
    return tuple((name, convert) for name, convert in found.items() if convert is not None)


def _evaluated(annotation: Any, names: dict[str, Any]) -> Any:
    if annotation is Parameter.empty:
        return Any
    return eval(annotation, names) if isinstance(annotation, str) else annotation
