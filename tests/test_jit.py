"""The kernels' decorator: lazy, cached on disk by the digest of all sources, safe about NaN."""

import importlib
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numba.core.errors import NumbaError

import epipole
from epipole import _jit
from epipole._jit import SAFE_FASTMATH, cache_folder, compile_seconds, kernel, storage
from epipole._jit.linking import Kernel
from epipole.pipelines.sfm.warm_up import warm_up
from whole import IS_WHOLE, in_whole_run


@kernel
def _mean_of_finite(values):
    total, count = 0.0, 0
    for i in range(len(values)):
        if np.isfinite(values[i]):
            total += values[i]
            count += 1
    return total / count


@kernel(inline=True, extra_fastmath=frozenset({"reassoc"}))
def _dot(a, b):
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@kernel
def _length(a):
    return np.sqrt(_dot(a, a))


def test_kernels_are_compiled_at_the_first_call_only() -> None:
    @kernel
    def twice(x):
        return 2 * x

    def times_made() -> int:
        return sum(twice.stats.cache_hits.values()) + sum(twice.stats.cache_misses.values())

    assert twice.signatures == [] and times_made() == 0
    assert twice(21) == 42 and times_made() == 1
    before = compile_seconds()
    assert twice(4) == 8 and times_made() == len(twice.signatures) == 1 and compile_seconds() == before


def test_time_spent_compiling_is_counted_once() -> None:
    """A callee that is compiled inside its caller is part of the caller's time."""
    clock = _jit._CompileClock()
    start = time.perf_counter()
    clock.on_start(None)
    clock.on_start(None)
    time.sleep(0.02)
    clock.on_end(None)
    assert clock.seconds == 0.0
    clock.on_end(None)
    assert 0.02 <= clock.seconds <= time.perf_counter() - start


def test_the_kernel_that_is_compiled_has_a_name() -> None:
    clock = _jit._CompileClock()
    clock.on_start(SimpleNamespace(data={"dispatcher": _mean_of_finite}))
    assert clock.current == f"{__name__.rpartition('.')[2]}._mean_of_finite"
    clock.on_end(None)
    assert clock.current == "" and clock.count == 1
    assert re.fullmatch(r"\d+ kernels? compiled", _jit.compiled_so_far()) and not _jit.is_compiling()


def test_nan_and_infinity_are_seen() -> None:
    """fastmath=True would answer NaN or infinity here."""
    assert not {"nnan", "ninf", "fast"} & SAFE_FASTMATH
    values = np.array([1.0, np.nan, 3.0, np.inf, -np.inf])
    assert _mean_of_finite(values) == _mean_of_finite.py_func(values) == 2.0


def test_division_by_zero_follows_numpy() -> None:
    assert np.isnan(_mean_of_finite(np.array([np.nan])))


def test_inlined_helpers() -> None:
    assert _length(np.array([3.0, 4.0])) == pytest.approx(5.0, rel=1e-15)
    assert "reassoc" in _dot.targetoptions["fastmath"] and "reassoc" not in _length.targetoptions["fastmath"]


def test_what_only_kernels_call_is_no_machine_code() -> None:
    """It is compiled once, into each kernel that Python calls, and gives the same numbers as when called itself."""

    @kernel
    def scaled(x, scale):
        return scale * x

    @kernel
    def total(values, scale):
        sum_ = 0.0
        for value in values:
            sum_ += scaled(value, scale)
        return sum_

    values = np.array([1.0, np.nan, 2.5])[[0, 2]]
    assert total(values, 2.0) == 7.0
    assert scaled.signatures == [] and len(scaled.callee.overloads) == 1
    (only,) = scaled.callee.overloads.values()
    assert only.library.get_pointer_to_function(only.fndesc.mangled_name) == 0
    with pytest.raises(TypeError, match="takes no arguments"):
        only.entry_point(1.0, 2.0)
    assert scaled(1.5, 2.0) == 3.0 and scaled.nopython_signatures[0].args == only.signature.args


def test_kernels_are_serial_cached_and_release_the_interpreter_lock() -> None:
    options = _length.targetoptions
    assert options["nogil"] and not options.get("parallel", False) and options["error_model"] == "numpy"
    assert _length._cache.cache_path.startswith(str(cache_folder()))


def test_a_type_checking_wrapper_is_removed() -> None:
    """The import hook of this test run wraps every function; Numba could not compile the wrapper."""
    from epipole.cameras import _camera_kernels

    assert not hasattr(_camera_kernels.project_one.py_func, "__wrapped__")
    assert hasattr(_jit.cache_folder, "__wrapped__")


def run_python(code: str, **environment: str) -> str:
    env = {**os.environ, **environment}
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    assert out.returncode == 0, out.stderr
    return out.stdout.strip()


COMPILE = (
    "from epipole._jit import compile_seconds;"
    "from epipole.cameras._camera_kernels import expand_params as f;"
    "import numpy as np; f(0, np.ones(8)); print(compile_seconds())"
)


def test_a_second_process_compiles_nothing(tmp_path: Path) -> None:
    assert float(run_python(COMPILE, EPIPOLE_CACHE_DIR=str(tmp_path))) > 0
    assert list(tmp_path.rglob("*.nbc"))
    assert float(run_python(COMPILE, EPIPOLE_CACHE_DIR=str(tmp_path))) == 0.0


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="the fallback is tested with POSIX paths")
def test_an_unusable_cache_folder_is_no_reason_to_stop(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    code = "from epipole._jit import cache_folder; print(cache_folder())"
    env = {"EPIPOLE_CACHE_DIR": str(blocked), "TMPDIR": str(tmp_path)}
    folder = Path(run_python(code, **env))
    assert folder.is_dir() and folder.is_relative_to(tmp_path) and folder.name == cache_folder().name


@pytest.mark.parametrize("mode", ["linked"] + IS_WHOLE * ["plain"])
def test_kernels_that_are_cut_short_are_compiled_again(tmp_path: Path, mode: str) -> None:
    """Either of the two files of a kernel, cut anywhere; and a byte that has changed, which only digests tell."""
    env = {"EPIPOLE_CACHE_DIR": str(tmp_path), "EPIPOLE_KERNELS": mode}
    assert float(run_python(COMPILE, **env)) > 0
    kept = {path: path.read_bytes() for path in tmp_path.rglob("*.nb[ic]")}
    assert {path.suffix for path in kept} == {".nbi", ".nbc"}
    cuts = [lambda data: data[: len(data) // 2], lambda _: b""]
    if mode == "linked":
        cuts[1] = lambda data: data[:-300] + bytes([data[-300] ^ 1]) + data[-299:]
    for suffix, cut in zip((".nbi", ".nbc"), cuts):
        for path in (path for path in kept if path.suffix == suffix):
            path.write_bytes(cut(kept[path]))
        assert float(run_python(COMPILE, **env)) > 0
    assert float(run_python(COMPILE, **env)) == 0.0


@in_whole_run
def test_kernels_of_a_type_that_was_moved_are_compiled_again(tmp_path: Path) -> None:
    """Unpickling their index fails, because the module that had the type of an argument lacks it now."""
    moved = (
        "from numba.core import caching\n"
        "def unpickle(self): raise AttributeError('the module has no such type')\n"
        "caching.IndexDataCacheFile._load_index = unpickle\n"
    )
    assert float(run_python(COMPILE, EPIPOLE_CACHE_DIR=str(tmp_path))) > 0
    assert float(run_python(moved + COMPILE, EPIPOLE_CACHE_DIR=str(tmp_path))) > 0


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="POSIX rights")
def test_code_from_a_folder_that_others_may_write_to_is_not_run(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    (shared / "cache" / "kernels").mkdir(parents=True)
    assert storage.why_not_trusted(shared / "cache") == ""
    for mode, words in ((0o777, "anyone may write"), (0o1777, ""), (0o755, "")):
        shared.chmod(mode)
        assert words in storage.why_not_trusted(shared / "cache" / "kernels")
        assert bool(words) == bool(storage.why_not_trusted(shared / "cache" / "kernels"))
    (shared / "cache").chmod(
        0o1777
    )  # the sticky bit guards what lies in a folder, not the folder's own contents
    assert "anyone may write" in storage.why_not_trusted(shared / "cache")
    shared.chmod(0o777)
    code = "from epipole._jit import cache_folder; print(cache_folder())"
    env = {**os.environ, "EPIPOLE_CACHE_DIR": str(shared / "cache")}
    given = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    assert f"anyone may write to {shared}" in given.stderr
    found = Path(given.stdout.strip())
    assert not found.is_relative_to(shared) and found.stat().st_mode & 0o077 == 0


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives files away")
def test_code_from_a_folder_of_another_user_is_not_run(tmp_path: Path) -> None:
    (tmp_path / "theirs" / "kernels").mkdir(parents=True)
    os.chown(tmp_path / "theirs", 12345, 12345)
    assert "belongs to another user" in storage.why_not_trusted(tmp_path / "theirs" / "kernels")


def test_a_full_disk_under_the_kernels_does_not_end_a_run(tmp_path: Path) -> None:
    """No file may grow: kernels work from memory, with one warning."""
    limit = "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
    limit += "from epipole._jit import cache_folder; cache_folder();"
    limit += "resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0));"
    assert float(run_python(limit + COMPILE, EPIPOLE_CACHE_DIR=str(tmp_path), EPIPOLE_KERNELS="linked")) > 0


def test_the_folder_follows_the_sources_of_all_kernels(tmp_path: Path) -> None:
    """Numba does not see that a callee in another file has changed; the digest does."""
    source = Path(epipole.__file__).parent
    for room in ("a", "b"):
        package = tmp_path / room / "epipole"
        (package / "cameras").mkdir(parents=True)
        for name in ("__init__.py", "_version.py", "errors.py"):
            (package / name).write_text((source / name).read_text())
        shutil.copytree(source / "_jit", package / "_jit", ignore=shutil.ignore_patterns("__pycache__"))
        (package / "cameras" / "_x_kernels.py").write_text(f"# {room}\n")
        (package / "cameras" / "x.py").write_text(f"# {room}\n")
    code = "from epipole._jit import cache_folder; print(cache_folder())"

    def name(room: str) -> str:
        env = {"EPIPOLE_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path / room)}
        return Path(run_python(code, **env)).name

    first = name("b")
    (tmp_path / "b" / "epipole" / "cameras" / "x.py").write_text("# what else a room holds does not count\n")
    assert name("b") == first
    (tmp_path / "b" / "epipole" / "cameras" / "_x_kernels.py").write_text("# a\n")
    assert name("b") not in (first, name("a"))  # nor would Numba take what another installation has compiled


def test_a_kernel_that_allocates_has_to_say_so() -> None:
    @kernel(allocates=True)
    def room(n):
        return np.empty(n)

    @kernel
    def room_unsaid(n):
        return np.empty(n)

    assert room(3).shape == (3,)
    with pytest.raises(NumbaError):
        room_unsaid(3)


def test_kernels_are_warmed_up_once_per_process(monkeypatch: pytest.MonkeyPatch) -> None:
    warm_up()
    for part in ("warm_up_features", "warm_up_mapping", "warm_up_verification"):
        monkeypatch.setattr(f"{warm_up.__module__}.{part}", lambda: pytest.fail("again"))
    warm_up()


def test_kernels_that_borrow_their_arrays_return_none() -> None:
    """A borrowed array that is returned would not be counted, and could be freed under its reader."""
    warm_up()
    package = Path(epipole.__file__).parent
    seen = 0
    for source in sorted(package.rglob("_*_kernels.py")):
        name = ".".join(("epipole", *source.relative_to(package).with_suffix("").parts))
        for function in vars(importlib.import_module(name)).values():
            if not isinstance(function, Kernel) or function.targetoptions["_nrt"]:
                continue
            for overload in (*function.overloads.values(), *function.callee.overloads.values()):
                seen += 1
                assert "array" not in str(overload.signature.return_type), f"{name}.{function.__name__}"
    assert seen > 10  # those called from Python and their callees, as far as they were compiled just now
