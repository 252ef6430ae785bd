"""Objects of SLAM as JSON and arrays, and back: no code is stored, and none is run.

What several objects hold is one object again afterwards. Arrays keep their kind, shape and order in memory, so that
sums over them go on with the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from epipole.geometry import Rigid3, Similarity3
from epipole.inertial import ImuNoise, InertialAlignment
from epipole.pipelines.slam import (
    frames,
    inertial_ties,
    local_mapping,
    loop_closing,
    map_tracking,
    path,
    picture_watch,
    recent_motion,
    record,
    slam_map,
    starting,
    static_points,
    tracking,
    turning,
)
from epipole.pipelines.slam.state_tables import attributes_of, problem_of_objects

Json = Any
_MODULES: tuple[ModuleType, ...] = (
    *(frames, inertial_ties, local_mapping, loop_closing, map_tracking, path),
    *(picture_watch, recent_motion, record, slam_map, static_points, starting, tracking, turning),
)
KINDS: dict[str, type] = {
    name: kind
    for module in _MODULES
    for name, kind in vars(module).items()
    if isinstance(kind, type) and kind.__module__ == module.__name__
} | {kind.__name__: kind for kind in (Rigid3, Similarity3, InertialAlignment, ImuNoise)}
"""What may be stored."""
CUT: dict[type, tuple[str, ...]] = {slam_map.SlamMap: ("_xyz", "_anchor", "_anchor_px", "_num_agreed")}
"""Arrays of which only the first `num_points` rows are in use."""
PICTURES: dict[type, tuple[str, ...]] = {slam_map.Keyframe: ("grey", "ignored_mask")}
"""Arrays that are never written to, and stay."""
LASTING: dict[type, tuple[str, ...]] = {
    slam_map.Keyframe: ("pixels", "disparity_px", "point", "descriptors", "look"),
    frames.Frame: ("grey", "right_grey", "depth", "ignored_mask"),
    path.Path: ("_full",),
    tracking.SeenFrame: ("pixels", "point", "disparity_px"),
}
"""Arrays, and lists of them, that are replaced, some of them soon, and never written to."""


class Coded(NamedTuple):
    """Objects as JSON, and the arrays that it names by their place."""

    structure: Json
    arrays: list[np.ndarray]
    pictures: frozenset[int] = frozenset()
    """Those that are never written to, and stay."""
    lasting: frozenset[int] = frozenset()
    """Others that are never written to."""


class BadState(ValueError):
    """What was read is not what was written."""


def encode(value: object, known: Mapping[str, object]) -> Coded:
    """An object and all that it holds.

    Args:
        value: the object.
        known: objects that are there already when it is read; they are named, not stored.

    Raises:
        TypeError: it holds something of another kind than `KINDS`.
    """
    coder = _Encoder({id(one): name for name, one in known.items()})
    structure = coder.code(value)
    ids = [id(array) for array in coder.arrays]
    pictures = frozenset(n for n, one in enumerate(ids) if one in coder.pictures)
    lasting = frozenset(n for n, one in enumerate(ids) if one in coder.lasting) - pictures
    return Coded(structure, coder.arrays, pictures, lasting)


def decode(coded: Coded, known: Mapping[str, object]) -> Any:
    """What `encode` was given.

    Raises:
        BadState: it is not what `encode` returned, or `known` lacks something.
    """
    try:
        decoder = _Decoder(coded.arrays, known)
        value = decoder.value(coded.structure)
        problem = problem_of_objects(decoder.made())
    except (
        KeyError,
        IndexError,
        TypeError,
        ValueError,
        OverflowError,
        AttributeError,
        RecursionError,
    ) as error:
        raise BadState(f"its objects do not fit ({error or type(error).__name__})") from error
    if problem:
        raise BadState(f"its objects do not fit ({problem})")
    return value


def table_of(arrays: Sequence[np.ndarray]) -> list[Json]:
    """Kind, shape and order of arrays."""
    return [[a.dtype.str, list(a.shape), "C" if a.flags.c_contiguous else "F"] for a in arrays]


def num_bytes_of(row: Json) -> int:
    """Length of an array.

    Raises:
        BadState: there is no such array.
    """
    try:
        kind, shape, order = row
        kind = np.dtype(kind)
        count = math.prod(_natural(side) for side in shape)
    except (TypeError, ValueError, LookupError, SyntaxError) as error:
        raise BadState("an array's kind or shape is none") from error
    if kind.kind not in "biuf" or order not in ("C", "F"):
        raise BadState("an array's kind or shape is none")
    return int(kind.itemsize * count)


def array_of(row: Json, data: bytes | memoryview) -> np.ndarray:
    """An array that may be written to, from its bytes.

    Raises:
        BadState: they are not as many as it has.
    """
    if len(data) != num_bytes_of(row):
        raise BadState("an array is cut off")
    kind, shape, order = row
    return np.frombuffer(data, np.dtype(kind)).reshape(shape, order=order).copy(order=order)


def bytes_of(array: np.ndarray) -> bytes:
    """In the order of `table_of`."""
    return array.tobytes("C" if array.flags.c_contiguous else "F")


class _Encoder:
    def __init__(self, known: dict[int, str]) -> None:
        self.known, self.arrays = known, list[np.ndarray]()
        self.pictures: set[int] = set()
        self.lasting: set[int] = set()
        self._array_of: dict[int, int] = {}
        self._number_of: dict[int, int] = {}
        self._held: list[object] = []

    def code(self, value: Any) -> Json:
        kind = type(value)
        if value is None or kind in (bool, int, float, str):
            return value
        if id(value) in self.known:
            return ["known", self.known[id(value)]]
        if kind is np.ndarray:
            return ["array", self._place(value)]
        if kind in (list, tuple):
            return [kind.__name__, *map(self.code, value)]
        if kind is set:
            return ["set", *map(self.code, sorted(value))]
        if kind is dict:
            return ["dict", *([self.code(k), self.code(v)] for k, v in value.items())]
        if isinstance(value, np.generic):
            return self.code(value.item())
        if KINDS.get(kind.__name__) is not kind:
            raise TypeError(f"{kind.__name__} has no place in a checkpoint")
        if isinstance(value, Enum):
            return ["enum", kind.__name__, value.value]
        if isinstance(value, tuple):
            return ["named", kind.__name__, *map(self.code, value)]
        return self._object(value, kind)

    def _object(self, value: Any, kind: type) -> Json:
        if id(value) in self._number_of:
            return ["again", self._number_of[id(value)]]
        self._number_of[id(value)] = len(self._number_of)
        cut = CUT.get(kind, ())
        held = {name: getattr(value, name) for name in _names_of(value)}
        for name in cut:
            held[name] = held[name][: value.num_points]
            self._held.append(held[name])
        for found, names in ((self.pictures, PICTURES.get(kind, ())), (self.lasting, LASTING.get(kind, ()))):
            for name in names:
                found.update(map(id, held[name] if isinstance(held[name], list) else [held[name]]))
        return ["object", kind.__name__, {name: self.code(one) for name, one in held.items()}]

    def _place(self, array: np.ndarray) -> int:
        place = self._array_of.setdefault(id(array), len(self.arrays))
        if place == len(self.arrays):
            self.arrays.append(array)
        return place


class _Decoder:
    def __init__(self, arrays: Sequence[np.ndarray], known: Mapping[str, object]) -> None:
        self.arrays, self.known, self._made = arrays, known, list[object]()
        self._rows: list[object] = []

    def made(self) -> list[object]:
        """All objects, and named tuples."""
        return [*self._made, *self._rows]

    def value(self, code: Json) -> Any:
        if code is None or type(code) in (bool, int, float, str):
            return code
        what, *rest = code
        return self._makers()[what](rest)

    def _makers(self) -> dict[str, Callable[[list[Any]], Any]]:
        return {
            "known": lambda rest: self.known[rest[0]],
            "array": lambda rest: self.arrays[_natural(rest[0])],
            "list": lambda rest: [self.value(one) for one in rest],
            "tuple": lambda rest: tuple(self.value(one) for one in rest),
            "set": lambda rest: {self.value(one) for one in rest},
            "dict": lambda rest: {self.value(key): self.value(one) for key, one in rest},
            "enum": lambda rest: _of_kind(rest[0], Enum)(rest[1]),
            "named": self._named,
            "again": lambda rest: self._made[_natural(rest[0])],
            "object": self._object,
        }

    def _named(self, rest: list[Any]) -> object:
        made = _of_kind(rest[0], tuple)(*(self.value(one) for one in rest[1:]))
        self._rows.append(made)
        return made

    def _object(self, rest: list[Any]) -> object:
        kind = _of_kind(rest[0], object)
        if issubclass(kind, (Enum, tuple)):
            raise TypeError(f"{rest[0]} is no such object")
        made = object.__new__(kind)
        self._made.append(made)
        held = {name: self.value(one) for name, one in rest[1].items()}
        if set(attributes_of(kind)) != set(held):
            raise TypeError(f"{rest[0]} has other attributes")
        for name, one in held.items():
            object.__setattr__(made, name, one)
        return made


def _names_of(value: Any) -> list[str]:
    return [field.name for field in fields(value)] if is_dataclass(value) else list(vars(value))


def _of_kind(name: str, base: type) -> Any:
    kind = KINDS[name]
    if not issubclass(kind, base):
        raise TypeError(f"{name} is no {base.__name__}")
    return kind


def _natural(number: Any) -> int:
    if type(number) is not int or number < 0:
        raise IndexError(number)
    return number
