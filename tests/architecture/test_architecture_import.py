"""`import epipole` is quick, compiles nothing and leaves no trace."""

import importlib.metadata
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from architecture_sources import PACKAGE

PROBE = """
import json, logging, os, sys, threading, time, warnings
handlers, filters, before = list(logging.root.handlers), list(warnings.filters), dict(os.environ)
begin = time.perf_counter()
import epipole
seconds = time.perf_counter() - begin
print(json.dumps({
    "seconds": seconds,
    "modules": sorted(sys.modules),
    "handlers": logging.root.handlers != handlers or any(
        logger.handlers for name, logger in logging.root.manager.loggerDict.items()
        if name.startswith("epipole") and isinstance(logger, logging.Logger)),
    "filters": warnings.filters != filters,
    "environment": dict(os.environ) != before,
    "threads": threading.active_count(),
    "names": dir(epipole),
}))
"""
HEAVY = {"jinja2", "numpy", "numba", "scipy", "cv2", "tyro", "rich", "PIL", "jaxtyping", "beartype"}


def run_python(code: str, folder: Path) -> str:
    env = {**os.environ, "HOME": str(folder), "XDG_CACHE_HOME": str(folder / "cache"), "TMPDIR": str(folder)}
    env.pop("EPIPOLE_CACHE_DIR", None)
    out = subprocess.run([sys.executable, "-c", code], cwd=folder, env=env, capture_output=True, text=True)
    assert out.returncode == 0, out.stderr
    assert not out.stderr
    return out.stdout


@pytest.fixture(scope="module")
def probes(tmp_path_factory: pytest.TempPathFactory) -> list[dict]:
    folder = tmp_path_factory.mktemp("import")
    found = [json.loads(run_python(PROBE, folder)) for _ in range(3)]
    assert not list(folder.iterdir()), "importing wrote files"
    return found


def test_importing_takes_less_than_half_a_second(probes: list[dict]) -> None:
    assert min(probe["seconds"] for probe in probes) < 0.5  # the best: others use this machine


def test_importing_loads_nothing_heavy(probes: list[dict]) -> None:
    assert not HEAVY & set(probes[0]["modules"])


def test_importing_has_no_side_effects(probes: list[dict]) -> None:
    for probe in probes:
        assert not probe["handlers"] and not probe["filters"] and not probe["environment"]
        assert probe["threads"] == 1


def test_every_room_imports_without_compiling_or_writing(tmp_path: Path) -> None:
    rooms = sorted(p.parent.name for p in PACKAGE.glob("*/__init__.py"))
    code = (
        f"import importlib; [importlib.import_module('epipole.' + r) for r in {rooms}];"
        "import logging, threading; from epipole._jit import compile_seconds, cache_folder;"
        "print(compile_seconds(), logging.root.handlers, threading.active_count(), cache_folder())"
    )
    seconds, handlers, threads, folder = run_python(code, tmp_path).split()
    assert (float(seconds), handlers, int(threads)) == (0.0, "[]", 1)
    # The folder of compiled kernels is all that there is, and it is empty.
    written = [p for p in tmp_path.rglob("*") if p.is_file()]
    assert not written and Path(folder).is_relative_to(tmp_path)


def test_the_public_names_are_there_and_no_others(tmp_path: Path) -> None:
    code = (
        "import epipole, types; print(epipole.__all__ == sorted(set(epipole.__all__), key=epipole.__all__.index));"
        "print([n for n in epipole.__all__ if n != '__version__' and not callable(getattr(epipole, n))"
        " and not isinstance(getattr(epipole, n), types.ModuleType)])"
        "\ntry: epipole.no_such_name\nexcept AttributeError as e: print(e)"
    )
    out = run_python(code, tmp_path).splitlines()
    assert out == ["True", "[]", "module 'epipole' has no attribute 'no_such_name'"]


def test_every_job_is_a_verb_also_after_its_folder_was_imported(tmp_path: Path) -> None:
    code = (
        "import epipole, epipole.api; from epipole.pipelines import stereo, calibration;"
        "print(all(callable(getattr(epipole, n)) for n in ('reconstruct', 'stereo', 'calibrate', 'view', 'splat')))"
    )
    assert run_python(code, tmp_path).split() == ["True"]


def test_the_version_is_that_of_the_distribution() -> None:
    import tomllib

    import epipole

    project = tomllib.loads((PACKAGE.parents[1] / "pyproject.toml").read_text())
    assert project["project"]["dynamic"] == ["version"]
    assert project["tool"]["setuptools"]["dynamic"]["version"]["attr"] == "epipole._version.__version__"
    assert epipole.__version__ == importlib.metadata.version("epipole")
    assert (PACKAGE / "py.typed").is_file()
