"""Run-time type checks for the whole test run, and what all tests share."""

import gc
import os
import shutil
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from threadpoolctl import threadpool_limits

sys.path.insert(0, str(Path(__file__).parent))
import type_checks
from whole import IS_WHOLE

# Every annotated function of the package checks the shapes and types of its arguments and results, in its first and some later calls in
# each test; an int may stand for a float, as in mypy. This must come before the first import of epipole.
CHECKER = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"
type_checks.install("epipole", CHECKER)

# The workers of the tests share the processors: threads of BLAS would only wait for each other, and use them up by that. NumPy's is
# loaded by a plugin before this file; the variable is for SciPy's, OpenCV's and those of other processes.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
threadpool_limits(1, user_api="blas")

# So would threads of the kernels, which take a sixth more time; results do not depend on their number. Tests of that, and of what runs in
# several threads, set it (`two_threads`).
os.environ.setdefault("EPIPOLE_NUM_THREADS", "1")

# Numba colors the message of every error, also of those by which it finds out which form of a function fits: 4 % of a compilation.
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")

# Made-up examples are few and the same in every run, and may take as long as a kernel compiles;
# `--hypothesis-profile=hunt` looks for new ones.
QUIET = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]
MOST_EXAMPLES = 40 if IS_WHOLE else 16
settings.register_profile(
    "epipole", derandomize=True, deadline=None, max_examples=MOST_EXAMPLES, suppress_health_check=QUIET
)
settings.register_profile("hunt", deadline=None, max_examples=600, suppress_health_check=QUIET, database=None)
settings.load_profile("epipole")


# As in the command: to search what libraries and kernels hold for cycles again and again takes a tenth of the time.
gc.set_threshold(200_000, 20, 100)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Wait for what a job that was refused still compiles: Numba catches warnings there, also those of the next test."""
    for thread in threading.enumerate():
        if thread.name == "epipole-compile":
            thread.join()
    type_checks.next_test()


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Types are not checked at run time: for tests that repeat many times what others have had checked."""
    with type_checks.switched_off():
        yield


@pytest.fixture(scope="module")
def unchecked_module() -> Iterator[None]:
    """The same for a whole file, and what its tests share."""
    with type_checks.switched_off():
        yield


@pytest.fixture(scope="module")
def two_threads() -> Iterator[None]:
    """Kernels and jobs use two threads: for tests of what runs side by side."""
    from epipole import _parallel

    _parallel.set_num_threads(2)
    yield
    _parallel.set_num_threads(None)


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers that are the same in every run, whatever runs before."""
    return np.random.default_rng(20260)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real data sets: `$EPIPOLE_DATA`, or `../shared/data` beside the repository."""
    requested = os.environ.get("EPIPOLE_DATA")
    folder = Path(requested) if requested else Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real data not found at {folder}; set EPIPOLE_DATA to the folder that holds them")
    return folder


BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Headless, with WebGL in software: one for all files of a process, in whose main thread no other asyncio loop can run then."""
    if BROWSER is None:
        pytest.skip("no Chromium on this machine")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch(
            executable_path=BROWSER, args=["--no-sandbox", "--force-prefers-reduced-motion", *SOFTWARE_GL]
        )
        yield opened
        opened.close()
