"""Converters for single annotations: numbers, choices, objects, and sequences of them."""

from __future__ import annotations

import math
import operator
import os
import re
import sys
import types
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from enum import Enum
from inspect import get_annotations
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from epipole._checks.kinds import Convert, Sizes
from epipole.errors import ConfigError, EpipoleError

_LARGEST = 2**63 - 1
_ADDRESS = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/+")  # at least two letters, as C:/ is a drive
_LONGEST_PATH, _LONGEST_NAME = 4095, 255
"""Limits of Linux in bytes; those of other systems are similar."""


def converter_of(annotation: Any) -> Convert | None:
    """The converter for an annotation; None if anything is accepted."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return converter_of(parts[0])
    if annotation is None or annotation is type(None):
        return _none
    if annotation is Any or annotation is object or isinstance(annotation, TypeVar):
        return None
    if hasattr(annotation, "dim_str"):  # jaxtyping: NumPy is loaded only for such annotations
        from epipole._checks.arrays import array_converter

        return array_converter(annotation)
    if origin in (Union, types.UnionType):
        others = (
            [part for part in parts if part not in (str, Path)] if {str, Path} <= {*parts} else list(parts)
        )
        paths = [_text_or_path] if len(others) < len(parts) else []
        return _one_of([*paths, *(converter_of(part) for part in others)])
    if origin is Literal:
        return _choice(parts)
    if origin is tuple:
        return _tuple(parts)
    if isinstance(origin, type) and issubclass(origin, Callable):  # type: ignore[arg-type]
        return _function
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return _mapping(parts)
    if isinstance(origin, type) and issubclass(origin, Iterable):
        return _items(origin, parts[0])
    kind = origin if origin is not None else annotation
    return _single(kind) if isinstance(kind, type) else None


def _single(kind: type) -> Convert:
    plain: dict[type, Convert] = {bool: _bool, int: _int, float: _float, Path: _path}
    if kind in plain:
        return plain[kind]
    return _member(kind) if issubclass(kind, Enum) else _instance(kind)


def _wrong(name: str, wanted: str, value: Any) -> ConfigError:
    came = type(value).__name__ if isinstance(value, Sized) and not isinstance(value, str) else repr(value)
    return ConfigError(f"{name} must be {wanted}, got {came[:60]}")


def _none(value: Any, name: str, _sizes: Sizes) -> None:
    if value is not None:
        raise _wrong(name, "None", value)


def _bool(value: Any, name: str, _sizes: Sizes) -> bool:
    if isinstance(value, bool):
        return value
    if str(getattr(value, "dtype", "")) == "bool" and getattr(value, "ndim", 1) == 0:  # NumPy's
        return bool(value)
    raise _wrong(name, "True or False", value)


def _int(value: Any, name: str, _sizes: Sizes) -> int:
    if type(value) is not int:
        try:
            if isinstance(value, bool):
                raise TypeError
            value = operator.index(value)
        except TypeError:
            raise _wrong(name, "a whole number", value) from None
    if abs(value) > _LARGEST:
        raise ConfigError(f"{name} must be a 64-bit number, got {str(value)[:60]}")
    return int(value)


def _float(value: Any, name: str, _sizes: Sizes) -> float:
    if type(value) is not float:
        try:
            if isinstance(value, (bool, str, bytes)) or getattr(value, "ndim", 0) != 0:
                raise TypeError
            # float() rejects complex numbers, whereas NumPy would drop the imaginary part.
            value = float(value) if not hasattr(value, "imag") or value.imag == 0 else None
            value = float(value)
        except (TypeError, ValueError, OverflowError):
            raise _wrong(name, "a number", value) from None
    if math.isnan(value):
        raise ConfigError(f"{name} must be a number, got NaN")
    return float(value)


def _path(value: Any, name: str, _sizes: Sizes) -> Path:
    if not isinstance(value, (str, os.PathLike)):
        raise _wrong(name, "a path", value)
    path: Path = _text_or_path(value if isinstance(value, Path) else Path(value), name, {})
    refuse_address(value, name)
    return path


def _text_or_path(value: Any, name: str, _sizes: Sizes) -> Any:
    """A path given as text or `Path`, unchanged."""
    if not isinstance(value, str | Path):
        raise _wrong(name, "a path", value)
    try:
        data = os.fsencode(value)
    except UnicodeEncodeError as error:
        raise ConfigError(f"{name} must be a path, but contains invalid characters") from error
    if not data:
        raise ConfigError(f"{name} must be a path, but is empty")
    if b"\0" in data:
        raise ConfigError(f"{name} must be a path, but contains a null character")
    if len(data) > _LONGEST_PATH or max(map(len, data.split(b"/"))) > _LONGEST_NAME:
        raise ConfigError(f"{name} must be a path: {str(value)[:60]}... is too long")
    return value


def refuse_address(given: str | os.PathLike[str], name: str) -> None:
    """Reject URLs such as `https://...`, which become `https:/...` when a path is joined or printed.

    Raises:
        ConfigError: it is a URL.
    """
    text = os.fspath(given)
    found = _ADDRESS.match(text) if isinstance(text, str) else None
    if found is None or Path(text).exists():
        return
    scheme, rest = found[1].lower(), text[found.end() :]
    if scheme == "file":
        raise ConfigError(f"{name} is {text}: leave the scheme out, as in /{rest.removeprefix('localhost/')}")
    is_stream = scheme in ("rtsp", "rtmp", "udp", "tcp")
    advice = "record the stream to a video file" if is_stream else "download it"
    raise ConfigError(
        f"{name} is the URL {found[1]}://{rest}, but only local files can be read: {advice} and pass its path"
    )


def _function(value: Any, name: str, _sizes: Sizes) -> Any:
    if not callable(value):
        raise _wrong(name, "a function", value)
    return value


def _instance(kind: type) -> Convert:
    article = "an" if kind.__name__[0] in "AEIOU" else "a"
    if issubclass(kind, tuple) and hasattr(kind, "_fields"):
        return _named_tuple(kind, article)

    def convert(value: Any, name: str, _sizes: Sizes) -> Any:
        if not isinstance(value, kind):
            # A list of rotations or motions is accepted: it is stacked to a batch.
            if isinstance(value, list) and hasattr(kind, "stack") and any(isinstance(v, kind) for v in value):
                return kind.stack(value)
            raise _wrong(name, f"{article} {kind.__name__}", value)
        return value

    return convert


def _named_tuple(kind: Any, article: str) -> Convert:
    """Converter for a named tuple, which does not check its fields itself."""
    plan: dict[str, Convert | None] = {}

    def convert(value: Any, name: str, _sizes: Sizes) -> Any:
        if not isinstance(value, kind):
            raise _wrong(name, f"{article} {kind.__name__}", value)
        if not plan:
            names = vars(sys.modules[kind.__module__])
            for field, annotation in get_annotations(kind).items():
                text = getattr(
                    annotation, "__forward_arg__", annotation
                )  # `NamedTuple` stores strings like this
                plan[field] = converter_of(eval(text, names) if isinstance(text, str) else text)
        changed = {}
        for field, one in plan.items():
            given = getattr(value, field)
            kept = given if one is None else one(given, f"{name}.{field}", {})
            if kept is not given:
                changed[field] = kept
        return value._replace(**changed) if changed else value

    return convert


def _member(kind: type[Enum]) -> Convert:
    def convert(value: Any, name: str, _sizes: Sizes) -> Enum:
        if isinstance(value, kind):
            return value
        try:
            if not isinstance(value, str):
                value = _int(value, name, {})
            return kind(value)
        except ValueError:  # from the enum, or a ConfigError
            raise _wrong(name, "one of " + ", ".join(map(str, kind)), value) from None

    return convert


def _choice(values: tuple[Any, ...]) -> Convert:
    def convert(value: Any, name: str, _sizes: Sizes) -> Any:
        for allowed in values:
            if type(allowed) is type(value) and allowed == value:
                return allowed
        if not isinstance(value, (str, bool)) and hasattr(value, "__index__"):
            number = _int(value, name, {})
            if number in values:
                return number
        raise _wrong(name, "one of " + ", ".join(map(str, values)), value)

    return convert


def _one_of(converters: list[Convert | None]) -> Convert | None:
    if None in converters:
        return None
    parts = [convert for convert in converters if convert is not None and convert is not _none]
    may_be_none = len(parts) < len(converters)

    def convert(value: Any, name: str, sizes: Sizes) -> Any:
        if value is None and may_be_none:
            return None
        first: EpipoleError | None = None
        for part in parts:
            try:
                return part(value, name, sizes)
            except EpipoleError as error:
                is_path = part is _path and isinstance(
                    value, os.PathLike
                )  # more specific than the error for text
                first = error if is_path else first or error
        raise first or _wrong(name, "None", value)

    return convert


def _tuple(parts: tuple[Any, ...]) -> Convert:
    is_any_length = len(parts) == 2 and parts[1] is Ellipsis
    converters = [converter_of(part) for part in parts if part is not Ellipsis]

    def convert(value: Any, name: str, sizes: Sizes) -> tuple[Any, ...]:
        rows = _listed(value, name)
        if not is_any_length and len(rows) != len(converters):
            raise ConfigError(f"{name} must have {len(converters)} values, got {len(rows)}")
        each = converters * len(rows) if is_any_length else converters
        out = tuple(
            row if one is None else one(row, f"{name}[{k}]", sizes)
            for k, (one, row) in enumerate(zip(each, rows))
        )
        is_same = isinstance(value, tuple) and all(a is b for a, b in zip(out, value))
        return value if is_same else out

    return convert


def _items(kind: type, part: Any) -> Convert:
    one = converter_of(part)

    def convert(value: Any, name: str, sizes: Sizes) -> Any:
        if kind in (Iterable, Iterator) and isinstance(value, Iterator):
            # Each item is checked when it is taken: what is given one after the other need not fit in memory.
            return (row if one is None else one(row, f"{name}[{k}]", sizes) for k, row in enumerate(value))
        rows = _listed(value, name)
        if one is None:
            return value if isinstance(value, kind) and issubclass(kind, Sequence) else rows
        # Axes with the same name must have the same length in all items.
        out = [one(row, f"{name}[{k}]", sizes) for k, row in enumerate(rows)]
        return kind(out) if kind in (set, frozenset) else out

    return convert


def _mapping(parts: tuple[Any, ...]) -> Convert:
    """Converter for keys and values, each by its annotation."""
    of_key, of_value = (converter_of(part) for part in parts)

    def convert(value: Any, name: str, _sizes: Sizes) -> Any:
        if not isinstance(value, Mapping):
            raise _wrong(name, "a mapping", value)
        out = {
            key if of_key is None else of_key(key, f"a key of {name}", {}): (
                one if of_value is None else of_value(one, f"{name}[{key!r:.40}]", {})
            )
            for key, one in value.items()
        }
        is_same = len(out) == len(value) and all(a is b and out[a] is value[b] for a, b in zip(out, value))
        return value if is_same else out

    return convert


def _listed(value: Any, name: str) -> list[Any]:
    if isinstance(value, (str, bytes, dict)) or not hasattr(value, "__iter__"):
        raise _wrong(name, "a sequence", value)
    try:
        return list(value)
    except TypeError:  # an array without axes
        raise _wrong(name, "a sequence", value) from None
