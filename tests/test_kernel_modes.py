"""Kernels linked, plain and as Python: how the mode is chosen, and that all give the same numbers."""

import json
import os
import subprocess
import sys
import warnings
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from epipole._jit import mode
from epipole._jit.as_python import MATH
from epipole._jit.mode import VARIABLE, KernelMode, kernel_mode
from epipole.errors import ConfigError
from whole import IS_WHOLE

SCRIPT = Path(__file__).with_name("kernel_mode_jobs.py")
LAST_DIGITS = 1e-7
"""Sums of the robust loop may be taken in another order (`reassoc`), and Python knows no fused multiplication; depths of
two views that stand close hang on the last digits of their pixels."""


JOBS = ("cameras", "homography", "adjustment", "stereo")
PLAIN_JOBS = JOBS if IS_WHOLE else ("cameras",)
"""Other kernels than those of cameras take half a minute to compile in the plain mode."""


@cache
def answers(how: KernelMode) -> dict:
    """What the jobs give in a process of this mode."""
    env = {key: value for key, value in os.environ.items() if key not in (VARIABLE, "NUMBA_DISABLE_JIT")}
    env |= {"NUMBA_DISABLE_JIT": "1"} if how is KernelMode.PYTHON else {VARIABLE: str(how)}
    jobs = PLAIN_JOBS if how is KernelMode.PLAIN else JOBS
    run = subprocess.run(
        [sys.executable, str(SCRIPT), *jobs], env=env, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout)
    assert found["mode"] == how
    return found


@pytest.mark.parametrize(
    ("how", "job"),
    [
        *((KernelMode.PLAIN, job) for job in PLAIN_JOBS if job != "homography"),
        *((KernelMode.PYTHON, job) for job in ("cameras", "stereo")),
    ],
)
def test_modes_agree_to_the_bit(how: KernelMode, job: str) -> None:
    assert answers(how)[job]["digest"] == answers(KernelMode.LINKED)[job]["digest"]


@pytest.mark.parametrize(
    ("how", "job"),
    [
        *((KernelMode.PLAIN, job) for job in PLAIN_JOBS if job == "homography"),
        (KernelMode.PYTHON, "homography"),
        (KernelMode.PYTHON, "adjustment"),
    ],
)
def test_modes_agree_to_the_last_digits(how: KernelMode, job: str) -> None:
    for found, expected in zip(answers(how)[job]["values"], answers(KernelMode.LINKED)[job]["values"]):
        np.testing.assert_allclose(found, expected, rtol=LAST_DIGITS, atol=LAST_DIGITS)


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> pytest.MonkeyPatch:
    """No mode is chosen, nothing is asked for, and nothing was tried before."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(mode, "cache_folder", lambda _mode: tmp_path)
    return monkeypatch


def chosen() -> KernelMode:
    return kernel_mode.__wrapped__()


@pytest.mark.parametrize("requested", ["linked", "plain"])
def test_the_mode_is_what_is_asked_for(fresh: pytest.MonkeyPatch, requested: str) -> None:
    fresh.setenv(VARIABLE, requested)
    fresh.setattr(mode.numba, "__version__", "9.9.9")
    assert chosen() == requested


def test_a_mode_that_is_none_is_an_error(fresh: pytest.MonkeyPatch) -> None:
    fresh.setenv(VARIABLE, "fast")
    with pytest.raises(ConfigError, match="linked or plain, got 'fast'"):
        chosen()


def test_nothing_is_tried_where_the_inside_of_numba_is_known(fresh: pytest.MonkeyPatch) -> None:
    fresh.setattr(mode, "_TRIAL", "raise SystemExit(1)")
    for version in ("0.61.0", "0.66.1", "0.68.9"):
        fresh.setattr(mode.numba, "__version__", version)
        assert chosen() is KernelMode.LINKED


@pytest.mark.parametrize("version", ["0.60.1", "0.69.0", "1.0.0rc1", "unknown"])
def test_another_numba_is_tried_once(fresh: pytest.MonkeyPatch, tmp_path: Path, version: str) -> None:
    fresh.setattr(mode.numba, "__version__", version)
    counter = tmp_path / "runs"
    fresh.setattr(mode, "_TRIAL", f"open({str(counter)!r}, 'a').write('x')")
    assert chosen() is KernelMode.LINKED and chosen() is KernelMode.LINKED
    assert counter.read_text() == "x"


@pytest.mark.parametrize(
    ("trial", "reason"),
    [
        ("raise ImportError('cannot import name Flags')", "cannot import name Flags"),
        ("import os; os.abort()", "ended with code -6"),
    ],
)
def test_kernels_are_plain_where_linking_fails(fresh: pytest.MonkeyPatch, trial: str, reason: str) -> None:
    fresh.setattr(mode.numba, "__version__", "0.99.0")
    fresh.setattr(mode, "_TRIAL", trial)
    for _ in range(2):  # the second answer was noted
        with pytest.warns(RuntimeWarning, match=f"cannot be linked on Numba 0.99.0.*{reason}"):
            assert chosen() is KernelMode.PLAIN
    fresh.setenv(VARIABLE, "plain")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert chosen() is KernelMode.PLAIN


def test_the_trial_tries_what_kernels_need() -> None:
    """It passes on this Numba, and fails where a piece of the inside has gone."""
    for change, works in (
        ("pass", True),
        ("linking._SealedFile._data_path = None", False),
        ("linking.JITCodeLibrary._finalize_dynamic_globals = None", False),
    ):
        code = f"from epipole._jit import linking; {change}; linking.try_linking()"
        run = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True)
        assert (run.returncode == 0) is works, change


def test_math_of_python_kernels_answers_as_numpy_does() -> None:
    with np.errstate(all="ignore"):
        assert np.isnan(MATH.sqrt(-1.0)) and MATH.log(0.0) == -np.inf and MATH.exp(1e4) == np.inf
        assert 1.0 / MATH.sqrt(0.0) == np.inf
    assert MATH.floor(-1.5) == -2 and MATH.ceil(np.nan) == -(2**63)
    assert isinstance(MATH.sqrt(np.float32(2)), np.float32) and isinstance(MATH.cos(0.0), np.float64)
