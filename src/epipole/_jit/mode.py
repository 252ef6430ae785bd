"""The three ways to run kernels: linked, plain, or as Python.

- LINKED: callees are linked into the kernels that call them and compiled once (`linking`). This uses internals of Numba's
  compiler, which any release may change.
- PLAIN: kernels are compiled by `numba.njit`. Methods of problems and vector rows use `numba.extending`, Numba's extension
  interface, and LLVM's builder. The results are the same, but a function is compiled again for every kernel that calls it,
  so the first run on a machine takes longer. Sums under `reassoc` may differ in the last digits.
- PYTHON: nothing is compiled; for a debugger, and hundreds of times slower.

`$EPIPOLE_KERNELS` requests linked or plain. Without it kernels are linked if that works on this Numba, and otherwise plain, with
a warning. `NUMBA_DISABLE_JIT=1`, Numba's own switch, runs them as Python.
"""

import os
import subprocess
import sys
import warnings
from enum import StrEnum
from functools import cache
from typing import Any, cast

import numba

from epipole._jit.storage import cache_folder, read_note, write_note
from epipole.errors import ConfigError

VARIABLE = "EPIPOLE_KERNELS"
_TESTED = ((0, 61), (0, 68))
"""The oldest and the newest Numba for which `linking` is known to work."""
_WORKS = "works"
_NOTE = "linking"
_TRIAL = "from epipole._jit.linking import try_linking; try_linking()"
_TRIAL_SECONDS = 120


class KernelMode(StrEnum):
    """How kernels run."""

    LINKED = "linked"
    PLAIN = "plain"
    PYTHON = "python"


@cache
def kernel_mode() -> KernelMode:
    """The mode of this process.

    Raises:
        ConfigError: `$EPIPOLE_KERNELS` is neither linked nor plain.
    """
    if cast(Any, numba.config).DISABLE_JIT:
        return KernelMode.PYTHON
    requested = os.environ.get(VARIABLE, "")
    if requested not in ("", KernelMode.LINKED, KernelMode.PLAIN):
        raise ConfigError(f"${VARIABLE} must be linked or plain, got {requested!r}")
    if requested:
        return KernelMode(requested)
    if _TESTED[0] <= _version(numba.__version__) <= _TESTED[1]:
        return KernelMode.LINKED
    reason = why_not_linked()
    if not reason:
        return KernelMode.LINKED
    warnings.warn(
        f"kernels cannot be linked on Numba {numba.__version__} ({reason}), so they are compiled individually,"
        f" which takes longer the first time (set ${VARIABLE}=plain to silence this warning)",
        RuntimeWarning,
        stacklevel=2,
    )
    return KernelMode.PLAIN


def why_not_linked() -> str:
    """Why kernels cannot be linked on this Numba (tried once, in a separate process); empty if they can."""
    folder = cache_folder(KernelMode.LINKED)
    answer = read_note(folder, _NOTE)
    if answer is None:
        answer = _try_linking()
        write_note(folder, _NOTE, answer)
    return "" if answer == _WORKS else answer


def _try_linking() -> str:
    if not sys.executable:
        return "no Python executable for a trial"
    try:
        trial = subprocess.run(
            [sys.executable, "-c", _TRIAL],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            check=False,
            text=True,
            timeout=_TRIAL_SECONDS,
            env={**os.environ, VARIABLE: KernelMode.PLAIN},
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"the trial did not run: {type(error).__name__}"
    if trial.returncode == 0:
        return _WORKS
    lines = trial.stderr.strip().splitlines()
    return lines[-1] if lines else f"the trial ended with code {trial.returncode}"


def _version(text: str) -> tuple[int, int]:
    """(0, 61) for 0.61.2; a version that cannot be parsed counts as the newest."""
    major, minor, *_ = [*text.split("."), "", ""]
    return (int(major), int(minor)) if major.isdigit() and minor.isdigit() else (sys.maxsize, 0)
