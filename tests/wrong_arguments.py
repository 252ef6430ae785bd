"""What may stand where a valid argument stood: other kinds, other shapes, other ranges; and other forms of the same."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from epipole.errors import EpipoleError

HUGE = 2**62
"""An index that no array has, and a size that no memory holds."""
OTHER_KINDS = (
    None,
    "nonsense",
    b"bytes",
    3,
    -1,
    0.5,
    True,
    1j,
    float("nan"),
    {},
    [],
    (),
    object(),
    [[1, 2], [3]],
)


def wrong_values(valid: Any, random: Random) -> list[Any]:
    """Values to try in place of a valid one; a few of them may be as good."""
    others = [*OTHER_KINDS, np.zeros(0), np.array(1.0), np.array(["a"]), np.array([None, {}])]
    if isinstance(valid, np.ndarray):
        return others + _arrays(valid)
    if isinstance(valid, Enum):
        return [*others, 99, -1, HUGE, str(valid), int(valid) if isinstance(valid, int) else 0]
    if isinstance(valid, bool):
        return [*others, 2, "yes", np.array([True, False])]
    if isinstance(valid, (int, float)):
        return others + _numbers()
    if isinstance(valid, str):
        return [*others, "", "nonsense", "\0", "a" * 1000]
    if isinstance(valid, tuple) and hasattr(valid, "_fields"):
        return others + [_replaced(valid, random) for _ in range(12)]
    if isinstance(valid, Path):
        return [
            *others,
            str(valid),
            "",
            "\0",
            "a" * 1000,
            (valid if valid.is_file() else valid.with_name("none")) / "none",
            valid.parent,
            Path("/dev/null"),
        ]
    if isinstance(valid, (list, tuple)):
        return others + _sequences(valid, random)
    if is_dataclass(valid) and not isinstance(valid, type):
        return others + [_Part(valid, random) for _ in range(12)]
    return others


def _replaced(valid: Any, random: Random) -> Any:
    """A named tuple, which checks nothing, with another field."""
    name = random.choice(valid._fields)
    value = random.choice(wrong_values(getattr(valid, name), random))
    try:
        return valid._replace(**{name: made(value)})
    except EpipoleError:  # a data class refuses it by itself
        return valid._replace(**{name: None})


def _numbers() -> list[Any]:
    whole = [0, -1, 1, 5, -(2**31), 2**31, 2**63, -(2**63), HUGE, 10**30, 10**400]
    broken = [1.5, -0.0, float("inf"), -float("inf"), 1e308, -1e308, 1e-308, 5e-324]
    arrays = [np.float32(1.0), np.int8(1), np.array([1.0, 2.0]), np.float64("nan"), np.bool_(True), "1"]
    return [*whole, *broken, *arrays]


def _arrays(valid: np.ndarray) -> list[Any]:
    out: list[Any] = [
        *(valid[None], valid[..., None], valid.ravel(), valid.T, valid.tolist(), valid.astype(object)),
        *(
            valid.astype(complex),
            valid.astype(bool),
            valid.astype(str),
            valid.astype("M8[s]") if valid.dtype.kind in "iu" else 0,
        ),
        *(np.zeros_like(valid), np.ones_like(valid), np.zeros((0, *valid.shape[1:])), np.zeros((3, 0))),
        *(
            np.zeros((5, 1)),
            np.zeros((1, 5)),
            np.ma.masked_all(valid.shape),
            np.zeros((0,) * max(valid.ndim, 1)),
        ),
    ]
    if valid.ndim and len(valid):
        out += [
            valid[:-1],
            np.concatenate([valid, valid[:1]]),
            valid[0],
            valid[..., :-1],
            valid[..., :1],
            valid[::-1],
        ]
        out += [np.repeat(valid, 2, axis=-1), np.repeat(valid, 3, axis=0)]
    numbers = valid.astype(np.float64)
    for bad in (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e160, 1e-308, 0.0, -1.0, 0.5, float(HUGE)):
        out.append(np.full(valid.shape, bad))
        one = numbers.copy()
        if one.size:
            one.flat[one.size // 2] = bad
        out.append(one)
    if valid.dtype.kind in "iu":
        for bad in (-1, -2, 5, 10**6, 2**31 - 1, -(2**31), 2**31, HUGE, -HUGE):
            one = valid.astype(np.int64)
            if one.size:
                one.flat[one.size // 2] = bad
            out += [one, np.full(valid.shape, bad, np.int64)]
            if np.iinfo(valid.dtype).min <= bad <= np.iinfo(valid.dtype).max:
                out += [one.astype(valid.dtype)]
        out += [numbers, numbers + 0.5, valid.astype(np.uint64)]
    return out + other_forms(valid)


def other_forms(valid: np.ndarray) -> list[np.ndarray]:
    """The same numbers, to single precision at least, in other types and layouts: each is as good as the first."""
    read_only = valid.copy()
    read_only.flags.writeable = False
    apart = np.repeat(valid, 2, axis=-1)[..., ::2] if valid.ndim else valid
    shifted = (
        np.empty(valid.nbytes + 1, np.uint8)[1:].view(valid.dtype).reshape(valid.shape)
        if valid.size
        else valid
    )
    shifted[...] = valid
    forms = [read_only, np.asfortranarray(valid), apart, shifted, valid.astype(valid.dtype.newbyteorder())]
    if valid.dtype.kind == "f":
        forms.append(valid.astype(np.float32))
    if valid.dtype.kind in "iu":
        forms += [valid.astype(np.int32), valid.astype(np.int64)]
    return forms


def _sequences(valid: list[Any] | tuple[Any, ...], random: Random) -> list[Any]:
    kind: Callable[[Any], Any] = type(valid)
    out = [kind(), kind([*valid, *valid]), kind(valid[:-1]), set(), iter(valid), kind([None] * len(valid))]
    for position in range(len(valid)):
        for bad in random.sample(wrong_values(valid[position], random), 6):
            out.append(kind([*valid[:position], bad, *valid[position + 1 :]]))
    return out


class _Part:
    """A data class's instance one of whose fields is wrong, to be made when it is called: making it may be refused."""

    def __init__(self, valid: Any, random: Random) -> None:
        self.valid = valid
        names = [f.name for f in fields(valid) if f.init]
        self.name = random.choice(names) if names else None
        value = random.choice(wrong_values(getattr(valid, self.name), random)) if self.name else None
        self.value = value

    def make(self) -> Any:
        """The instance."""
        arguments = {f.name: getattr(self.valid, f.name) for f in fields(self.valid) if f.init}
        value = self.value.make() if isinstance(self.value, _Part) else self.value
        return type(self.valid)(**arguments | ({self.name: value} if self.name else {}))

    def __repr__(self) -> str:
        return f"{type(self.valid).__name__}({self.name}={describe(self.value)})"


def made(value: Any) -> Any:
    """The argument to call with; raises what the class of a data class's instance raises."""
    return value.make() if isinstance(value, _Part) else value


def describe(value: Any) -> str:
    """An argument in a line."""
    if isinstance(value, np.ndarray):
        few = (
            np.array2string(value.ravel()[:4], threshold=4, separator=",")
            if value.dtype.kind in "biuf"
            else ""
        )
        layout = "" if value.flags.carray else " (read-only or scattered)"
        return f"{value.dtype}{value.shape} {few}{layout}"
    text = repr(value)
    return text if len(text) < 90 else text[:87] + "..."
