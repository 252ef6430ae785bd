"""Run-time type checks of annotated functions, in the first calls of each in a test, and in some later ones: loops stay fast.

jaxtyping's import hook writes `@jaxtyping.jaxtyped(typechecker=...)` to every function and class; `sampled` stands for it here. A
check takes tens of microseconds, a call that goes unchecked a tenth of one. What is checked is made at the first call, which
spares the many functions that no test of a process calls.
"""

import functools
import inspect
from collections.abc import Callable
from dataclasses import is_dataclass
from types import CodeType
from typing import Any

import jaxtyping

FIRST, EVERY = 2, 1000
"""So many calls of a function are checked in each test, and of later ones every so-many-th."""
_real: Any = jaxtyping.jaxtyped


class Turn:
    """Which test runs; negative where types are not checked."""

    number = 1


def next_test() -> None:
    """Each function's next calls are checked again."""
    if Turn.number > 0:
        Turn.number += 1


class switched_off:
    """Nothing is checked in the block."""

    def __enter__(self) -> None:
        self.before, Turn.number = Turn.number, -1

    def __exit__(self, *_: object) -> None:
        Turn.number = self.before
        next_test()


def install(package: str, checker: str) -> None:
    """Before the package's first import."""
    jaxtyping.jaxtyped = sampled
    jaxtyping.install_import_hook(package, checker)


def sampled(thing: Any = None, *, typechecker: Any) -> Any:
    """As `jaxtyping.jaxtyped`: of functions, methods, properties and data classes."""
    if thing is None:
        return functools.partial(sampled, typechecker=typechecker)
    if inspect.isclass(thing):
        if is_dataclass(thing) and not hasattr(thing.__init__, "is_sampled"):
            thing.__init__ = _sampled_function(thing.__init__, typechecker)
        return thing
    if isinstance(thing, (classmethod, staticmethod)):
        return type(thing)(sampled(thing.__func__, typechecker=typechecker))
    if isinstance(thing, property):
        parts = (thing.fget, thing.fset, thing.fdel)
        return property(*(part and _sampled_function(part, typechecker) for part in parts))
    return _sampled_function(thing, typechecker)


class _Count:
    """Of a function's calls in this test: one for all functions that are made of the same code."""

    __slots__ = ("code", "left", "turn")

    def __init__(self, code: CodeType) -> None:
        self.code, self.left, self.turn = code, FIRST, 0


_counts: dict[int, _Count] = {}
"""By the code's identity: data classes with the same fields have equal code."""


def _sampled_function(function: Callable[..., Any], typechecker: Any) -> Callable[..., Any]:
    code = getattr(inspect.unwrap(function), "__code__", None)
    if code is None or not getattr(function, "__annotations__", None):
        return function
    count, full = _counts.setdefault(id(code), _Count(code)), None

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal full
        if count.turn != Turn.number:
            count.turn = Turn.number
            count.left = FIRST if Turn.number > 0 else -1
        count.left -= 1
        if count.left < 0 and (count.left % EVERY or Turn.number < 0):
            return function(*args, **kwargs)
        if full is None:
            full = _real(function, typechecker=typechecker)
        return full(*args, **kwargs)

    call.is_sampled = True
    return call
