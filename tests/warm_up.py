"""Compile the kernels of the library before the tests, in two processes: `python tests/warm_up.py`.

Both workers of the tests would compile most of them twice. Jobs are left out: their kernels are those of the library.
"""

import subprocess
import sys
import tempfile
import warnings
from contextlib import chdir, suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from epipole.pipelines.sfm.warm_up import warm_up
from epipole.robust import __name__ as robust
from valid_calls import valid_calls
from valid_jobs import calls as job_calls


def call_all(*, of_robust: bool) -> None:
    """Call one half of the functions: estimators share kernels with each other, hardly any with the rest."""
    jobs = {name for name, _, _ in job_calls()}
    for call in valid_calls():
        if (
            call.name not in jobs
            and str(getattr(call.function, "__module__", "")).startswith(robust) is of_robust
        ):
            with suppress(Exception):  # the tests report it
                call.function(**call.arguments)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    is_helper = len(sys.argv) > 1
    helper = None if is_helper else subprocess.Popen([sys.executable, __file__, "robust"])
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        if not is_helper:
            warm_up()
        call_all(of_robust=is_helper)
    if helper is not None:
        helper.wait()
