"""Compilation of kernels that other kernels call.

Numba optimizes every function to machine code, together with everything it calls. With six levels of calls the innermost
function goes through LLVM six times. Here a callee is only lowered to LLVM IR and linked into its callers; a function called
from Python is optimized and compiled once, with everything below it. All uses of Numba internals are in this file; `mode`
handles versions in which they have changed.
"""

import io
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple, cast

import numba
import numpy as np
from numba import types
from numba.core.caching import IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, Flags
from numba.core.compiler_machinery import register_pass
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering
from numba.extending import overload_method

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


_SEAL_BYTES = 16


class Kernel(CPUDispatcher):
    """A compiled function; kernels that call it see its callee form instead."""

    def __init__(self, py_func: Any, targetoptions: dict[str, Any]) -> None:
        super().__init__(py_func, {}, targetoptions, _KernelCompiler)
        self.callee = _Callee(py_func, {}, {**targetoptions, "no_cpython_wrapper": True}, CalleeCompiler)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Used by Numba to type a call of this function."""
        return self.callee.get_call_template(args, kws)

    def get_overload(self, sig: Any) -> Any:
        """Used by Numba to lower a call of this function."""
        return self.callee.get_overload(sig)


class _Callee(CPUDispatcher):
    """The function as seen by kernels: compiled during their compilation, without Numba's timers and locks."""

    _compiler: Any

    def compile(self, sig: Any) -> Any:
        """The key of the library for these argument types."""
        arguments = tuple(sig)
        compiled: Any = self.overloads.get(arguments)
        if compiled is None:
            compiled = self._compiler.compile(arguments, None)
            self.add_overload(compiled)
        return compiled.entry_point


class _Flags(Flags):
    """Compiler options compared by stored values; Numba's own look up all defaults, 100,000 times a minute."""

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        return type(other) is _Flags and self._values == other._values

    def __hash__(self) -> int:
        return hash(frozenset(self._values))


class _KernelCompiler(Compiler):
    """Numba's compiler."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.state.flags = _Flags(self.state.flags)


class CalleeCompiler(_KernelCompiler):
    """Numba's passes, with another lowering."""

    def define_pipelines(self) -> list[Any]:
        """Passes that end with a library for linking."""
        (pipeline,) = super().define_pipelines()
        pipeline.passes = [
            (_CalleeLowering if step is NativeLowering else step, what) for step, what in pipeline.passes
        ]
        pipeline.finalize()
        return [pipeline]


@register_pass(mutates_CFG=True, analysis_only=False)
class _CalleeLowering(NativeLowering):
    """Lowers a typed function to a library that is only linked."""

    _name = "callee_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower without a callable address; instead, callers find the library by a unique key."""
        state.library = _LinkedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        state.library.finalize()
        key = object().__sizeof__  # any unique builtin method will do
        state.targetctx.insert_user_function(key, state.cr.fndesc, [state.library])
        state.cr = state.cr._replace(cfunc=key)
        return True


class _LinkedLibrary(JITCodeLibrary):
    """The code of a callee and everything it calls, neither optimized nor compiled."""

    def _optimize_final_module(self) -> None:
        """Leave optimization to the library that this one is linked into."""

    def _finalize_final_module(self) -> None:
        """Generate no machine code."""
        self._finalize_dynamic_globals()
        self._finalized = True


def linked_kernel(
    function: Callable[..., Any],
    *,
    fastmath: set[str],
    allocates: bool,
    inline: bool,
    fuse: bool,
    folder: Path,
) -> Kernel:
    """A kernel cached in the folder; for the other arguments see `epipole._jit.kernel`."""
    compiled = Kernel(
        function,
        targetoptions={
            "nopython": True,
            "nogil": True,
            "error_model": "numpy",
            "fastmath": fastmath,
            "inline": "always" if inline else "never",
            "forceinline": fuse,
            "_nrt": allocates,
            "no_cfunc_wrapper": True,  # only needed to pass kernels as values; it took 4 % of the compile time
        },
    )
    compiled.enable_caching()
    _seal_files(compiled, folder)
    return compiled


def linked_overload_options(*, fastmath: set[str], allocates: bool, fuse: bool) -> dict[str, Any]:
    """Options for Numba's `overload`, for functions called only by kernels."""
    return {
        "error_model": "numpy",
        "fastmath": fastmath,
        "forceinline": fuse,
        "_nrt": allocates,
        "no_cpython_wrapper": True,
        "no_cfunc_wrapper": True,
        "pipeline_class": CalleeCompiler,
    }


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Lock out other processes: Numba derives new file names from those it has read, so two could choose the same one."""
    with (folder / "lock").open("w") as stream:
        if fcntl is not None:
            fcntl.flock(stream, fcntl.LOCK_EX)
        yield


class _SealedFile(IndexDataCacheFile):
    """Numba's files of one kernel, each with its digest: damaged files are treated as missing."""

    folder: Path

    def save(self, key: Any, data: Any) -> None:
        """Save a kernel; if the disk is full, the next process compiles it again."""
        try:
            with _alone_in(self.folder):
                super().save(key, data)
        except OSError as error:
            warnings.warn(
                f"a compiled kernel cannot be saved in {self.folder}: {error.strerror}",
                RuntimeWarning,
                stacklevel=2,
            )

    def _load_index(self) -> Any:
        if not _is_whole(self._index_path):
            return {}
        # A named tuple of the arguments was moved or removed: compile again.
        try:
            return super()._load_index()
        except (AttributeError, ImportError):
            return {}

    def _load_data(self, name: str) -> Any:
        if not _is_whole(self._data_path(name)):
            raise FileNotFoundError(name)  # makes Numba compile it again
        return super()._load_data(name)

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[Any]:
        content = io.BytesIO()
        yield content
        with super()._open_for_write(filepath) as file:
            file.write(
                content.getvalue() + _seal(content.getvalue())
            )  # unpickling ignores what comes after the pickle


def _seal(content: bytes) -> bytes:
    return blake2b(content, digest_size=_SEAL_BYTES).digest()


def _is_whole(path: str) -> bool:
    try:
        content = Path(path).read_bytes()
    except OSError:
        return False
    return _seal(content[:-_SEAL_BYTES]) == content[-_SEAL_BYTES:]


def _seal_files(compiled: Any, folder: Path) -> None:
    kept = compiled._cache
    kept._cache_file = _SealedFile(
        kept._cache_path, kept._impl.filename_base, kept._impl.locator.get_source_stamp()
    )
    kept._cache_file.folder = folder


class _Row(NamedTuple):
    """Argument of the trial: a named tuple with a method, like the robust problems."""

    values: np.ndarray

    def sum_of(self, scale):  # type: ignore[no-untyped-def]
        """The sum of all values times the scale."""
        total = 0.0
        for value in self.values:
            total += scale * value
        return total


def try_linking() -> None:
    """Compile two kernels, one of which calls the other and a method, and save them; raises or crashes on failure."""
    with tempfile.TemporaryDirectory() as name:
        cast(Any, numba.config).CACHE_DIR = name
        borrowing: dict[str, Any] = {"fastmath": {"nsz"}, "allocates": False, "fuse": True}

        def choose(self, scale):  # type: ignore[no-untyped-def]  # noqa: ARG001 - Numba compares them
            return _Row.sum_of if self.instance_class is _Row else None

        options = linked_overload_options(**borrowing)
        cast(Any, overload_method)(types.BaseNamedTuple, "sum_of", jit_options=options)(choose)
        callee = linked_kernel(_largest, **borrowing, inline=False, folder=Path(name))

        def caller(row, out):  # type: ignore[no-untyped-def]
            out[0] = row.sum_of(2.0)
            return callee(row.values)

        kernel = linked_kernel(caller, **{**borrowing, "fuse": False}, inline=False, folder=Path(name))
        out = np.zeros(1)
        answer = kernel(_Row(np.array([1.0, 4.0, 2.5])), out)
        if answer != 4.0 or out[0] != 15.0 or callee.signatures or not any(Path(name).rglob("*.nbi")):
            raise RuntimeError(f"linked kernels give {answer} and {out[0]}")


def _largest(values):  # type: ignore[no-untyped-def]
    largest = values[0]
    for value in values:
        largest = max(largest, value)
    return largest
