"""Compile the kernels of the library before the tests, in two processes: `python tests/warm_up.py`.

Both workers of the tests would compile most of them twice, and the modules with their type checks. One process begins with the kernels
of features and mapping, the other with those of verification; then they call the public functions module by module, from both ends of
a list in which those that share kernels are neighbors.
"""

import subprocess
import sys
import tempfile
import warnings
from collections import defaultdict
from contextlib import chdir, suppress
from pathlib import Path

sys.path.insert(1, str(Path(__file__).parents[1]))

import conftest  # noqa: F401 - first: the type checks of the tests
import type_checks
from epipole import _jit, surface
from epipole.pipelines.sfm.warm_up import warm_up_features, warm_up_mapping, warm_up_verification
from epipole.robust import __name__ as robust
from valid_calls import Call, valid_calls
from valid_jobs import calls as job_calls


def calls_of_modules() -> list[tuple[str, list[Call]]]:
    """Estimators first: they share kernels with each other, hardly any with the rest."""
    jobs, modules = {name for name, _, _ in job_calls()}, defaultdict(list)
    for call in valid_calls():
        if call.name not in jobs:
            modules[getattr(call.function, "__module__", None) or "others"].append(call)
    return sorted(modules.items(), key=lambda item: (not item[0].startswith(robust), item[0]))


def is_claimed(name: str, claims: Path) -> bool:
    """Whether the other process has called this module's functions, or does; otherwise this one has to."""
    try:
        (claims / name).open("x").close()
    except FileExistsError:
        return True
    return False


def warm_up_surfaces() -> None:
    """The only job with kernels that no public function calls."""
    from benchmarks.tasks.surfaces import prepare_scene

    surface(prepare_scene("courtyard", Path("scene"), (192, 128), 4).folder, Path("out"), texture_px=256)


def compile_all(claims: Path, *, is_helper: bool) -> None:
    """What a process has to compile, and what is left of the common list."""
    if is_helper:
        warm_up_verification()
    else:
        warm_up_features()
        warm_up_mapping()
        with suppress(Exception):  # the tests report it
            warm_up_surfaces()
    modules = calls_of_modules()
    for name, calls in modules if is_helper else reversed(modules):
        if not is_claimed(name, claims):
            for call in calls:
                with suppress(Exception):
                    call.function(**call.arguments)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    is_helper = len(sys.argv) > 1
    with tempfile.TemporaryDirectory() as folder, chdir(folder), type_checks.switched_off():
        claims = Path(sys.argv[1] if is_helper else folder)
        helper = None if is_helper else subprocess.Popen([sys.executable, __file__, folder])
        compile_all(claims, is_helper=is_helper)
        if helper is not None:
            helper.wait()
            _jit.mark_compiled()
