"""What kernels are compared with: the same source run as plain Python, to its last callee.

A kernel that Python calls has a test marked `@reference_of(kernel)`; `architecture/test_architecture_kernels.py` looks
for those without. Most of these tests take the arguments that the package itself hands to the kernel
(`record_calls`) and compare what the compiled form makes of them with what the interpreter does.
"""

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from types import CodeType, FunctionType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import kernel_rows
from epipole._jit.as_python import MATH


def reference_of(*kernels: Any) -> Callable[[Any], Any]:
    """Say which kernels a test compares with a reference."""
    assert all(callable(kernel) for kernel in kernels)

    def mark(test: Any) -> Any:
        test.reference_of = (*getattr(test, "reference_of", ()), *kernels)
        return test

    return mark


def python_form(kernel: Any) -> Any:
    """The function that a kernel was compiled from; the kernel itself where Numba is switched off."""
    return getattr(kernel, "py_func", kernel)


def _as_in_kernels(constant: Any) -> Any:
    """Floats as NumPy's: a division by zero gives infinity, and with a float32 the result is double, as in kernels."""
    if type(constant) is float:
        return np.float64(constant)
    if isinstance(constant, CodeType):
        return constant.replace(co_consts=_as_in_kernels(constant.co_consts))
    return tuple(map(_as_in_kernels, constant)) if type(constant) is tuple else constant


def _plain_function(kernel: Any) -> FunctionType:
    """The Python form with the arithmetic of kernels."""
    f = kernel.py_func
    return FunctionType(_as_in_kernels(f.__code__), f.__globals__, f.__name__, f.__defaults__, f.__closure__)


def _unwritten(shape: Any, dtype: Any = np.float64) -> np.ndarray:
    """`np.empty` with NaN, so that the result tells whether anything was read before it was written."""
    return np.full(shape, np.iinfo(dtype).max if np.dtype(dtype).kind in "iu" else np.nan, dtype)


_NUMPY = SimpleNamespace(**{**vars(np), "empty": _unwritten})


def _plain(name: str, value: Any) -> Any:
    if value is math or value is np:
        return MATH if value is math else _NUMPY
    if hasattr(value, "py_func"):
        return _plain_function(value)
    if type(value).__name__ == "_Intrinsic":
        return getattr(kernel_rows, name, value)
    return _as_in_kernels(value) if type(value) is float else value


@contextmanager
def plain_python() -> Iterator[None]:
    """All kernels run as plain Python, and the rows of `_simd_kernels` as NumPy."""
    replaced = []
    modules = [m for name, m in sys.modules.items() if name.startswith("epipole.") and "_kernels" in name]
    for module in modules:
        for name, value in list(vars(module).items()):
            plain = _plain(name, value)
            if plain is not value:
                replaced.append((module, name, value))
                setattr(module, name, plain)
    try:
        with np.errstate(all="ignore"):
            yield
    finally:
        for module, name, value in replaced:
            setattr(module, name, value)


def assert_same(
    found: Any,
    expected: Any,
    *,
    rtol: float = 0.0,
    atol: float = 0.0,
    of_largest: float = 0.0,
    only_written: bool = False,
) -> None:
    """Equal bit by bit (but for the sign of zero), or to within a tolerance; tuples item by item.

    `of_largest` is a tolerance as a share of an array's largest number: for sums that nearly cancel. With
    `only_written`, what is expected to be NaN may be anything: copies of room that was never written.
    """
    if isinstance(expected, tuple):
        assert len(found) == len(expected)
        for one, other in zip(found, expected):
            assert_same(one, other, rtol=rtol, atol=atol, of_largest=of_largest, only_written=only_written)
        return
    if of_largest and np.asarray(expected).dtype.kind == "f":
        atol += of_largest * np.abs(expected).max(where=np.isfinite(expected), initial=0.0)
    if isinstance(expected, np.ndarray) and (found.dtype != expected.dtype or found.shape != expected.shape):
        raise AssertionError(f"{found.dtype} {found.shape} is not {expected.dtype} {expected.shape}")
    if only_written and isinstance(expected, np.ndarray) and expected.dtype.kind == "f":
        found = np.where(np.isnan(expected), np.nan, found)
    if rtol == atol == 0.0 or np.asarray(expected).dtype.kind not in "fc":
        np.testing.assert_array_equal(found, expected)
    else:
        np.testing.assert_allclose(found, expected, rtol=rtol, atol=atol)


def _copied(value: Any) -> Any:
    """Arguments as the kernel was compiled for: read-only arrays stay read-only."""
    if isinstance(value, tuple):
        parts = [_copied(part) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    copy = deepcopy(value)
    if isinstance(value, np.ndarray):
        copy.flags.writeable = value.flags.writeable
    return copy


def both_ways(kernel: Any, *arguments: Any) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """What a kernel and its Python form return, and their arguments as they are afterwards, each on copies."""
    ours, theirs = _copied(arguments), _copied(arguments)
    found = kernel(*ours)
    with plain_python():
        plain = _plain_function(kernel) if hasattr(kernel, "py_func") else kernel
        expected = plain(*theirs)
    return (found, ours), (expected, theirs)


def assert_same_as_python(
    kernel: Any, *arguments: Any, outputs: Sequence[int] | None = None, **tolerances: Any
) -> tuple[Any, Any]:
    """Compare what a kernel returns and writes with what its Python form does.

    Args:
        kernel: what Python calls.
        arguments: left as they are.
        outputs: positions of the arguments to be compared, where others are scratch; None: all.
        tolerances: of `assert_same`.

    Returns:
        what the kernel returned, and its arguments as they are afterwards.
    """
    (found, ours), (expected, theirs) = both_ways(kernel, *arguments)
    assert_same(found, expected, **tolerances)
    for k in range(len(arguments)) if outputs is None else outputs:
        assert_same(ours[k], theirs[k], **tolerances)
    return found, ours


def record_calls(monkeypatch: pytest.MonkeyPatch, module: ModuleType, kernel: Any) -> list[tuple[Any, ...]]:
    """The arguments, as they were before, of all calls that `module` makes of a kernel from now on."""
    calls: list[tuple[Any, ...]] = []
    name = python_form(kernel).__name__

    def spy(*arguments: Any) -> Any:
        calls.append(_copied(arguments))
        return kernel(*arguments)

    for alias, value in list(vars(module).items()):
        if value is kernel:
            monkeypatch.setattr(module, alias, spy)
            return calls
        if isinstance(value, ModuleType | SimpleNamespace) and getattr(value, name, None) is kernel:
            # The kernels' own module stays as it is: other kernels may be compiled meanwhile.
            monkeypatch.setattr(module, alias, SimpleNamespace(**{**vars(value), name: spy}))
            return calls
    raise AssertionError(f"{module.__name__} does not call {name}")
