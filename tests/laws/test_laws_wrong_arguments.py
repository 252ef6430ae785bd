"""Wrong arguments: a public function gives a result or an error of ours, and compiles no kernel for other forms of the same.

`tests/fuzz/wrong_calls.py` draws from the same table without end, and survives crashes.
"""

import inspect
import re
import sys
import warnings
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

import valid_files
import valid_jobs
from epipole.errors import EpipoleError
from valid_calls import ROOMS, Call, valid_calls
from whole import IS_WHOLE
from wrong_arguments import describe, made, wrong_values

OF_EACH_ARGUMENT = 5 if IS_WHOLE else 2
JOBS = {name for name, _, _ in valid_jobs.calls()}
CALCULATING = [call for call in valid_calls() if call.name not in JOBS]
"""Jobs run kernels of many kinds, on inputs that are found too poor."""
RESULTS = {
    *(
        "ImuFactors",
        "PathFactors",
        "BundleCovariance",
        "BundleIteration",
        "BundleResult",
        "PoseGraphResult",
        "Estimate",
        "FocalMotion",
    ),
    *(
        "FocalPose",
        "PairGeometry",
        "Triangulation",
        "CameraAlignment",
        "CameraErrors",
        "DriftPerLength",
        "TrajectoryError",
        "TrajectoryEvaluation",
        "TrajectoryScore",
        "RefinedPose",
        "InertialAlignment",
        "Preintegrated",
        "ObjectFit",
        "ScaleFit",
        "Rendering",
        "Snapshot",
    ),
}
"""What functions return: nobody has to make one."""


def test_every_public_function_has_a_call() -> None:
    called = {call.function for call in valid_calls()} | {type(call.function) for call in valid_calls()}
    names = {call.name.split(".")[0].split(" ")[0] for call in valid_calls()}
    missing = []
    for room in ROOMS:
        for name, value in vars(room).items():
            if (
                name.startswith("_")
                or name in RESULTS | valid_files.RESULTS | valid_files.FOLDERS_ALONE
                or not (inspect.isfunction(value) or inspect.isclass(value))
            ):
                continue
            if inspect.isclass(value) and issubclass(value, Enum):
                continue
            if value not in called and name not in names:
                missing.append(f"{room.__name__}.{name}")
    assert not missing, missing


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("call", valid_calls(), ids=repr)
def test_wrong_arguments_are_refused_or_harmless(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # a wrong argument may be a name to write to
    for name, valid in call.arguments.items():
        random = Random(f"{call.name}: {name}")
        values = wrong_values(valid, random)
        for value in random.sample(values, min(OF_EACH_ARGUMENT, len(values))):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    call.function(**call.arguments | {name: made(value)})
            except EpipoleError as error:
                assert str(error)
            except Exception as error:
                raise AssertionError(f"{call.name}({name}={describe(value)})") from error


def _read_only(array: np.ndarray) -> np.ndarray:
    out = array.copy()
    out.flags.writeable = False
    return out


def _scattered(array: np.ndarray) -> np.ndarray:
    return np.repeat(array, 2, axis=-1)[..., ::2] if array.ndim else array


def _swapped(array: np.ndarray) -> np.ndarray:
    return array.astype(array.dtype.newbyteorder())


def _foreign(array: np.ndarray) -> np.ndarray:
    """The three at once."""
    out = _scattered(_swapped(array)).view()
    out.flags.writeable = False
    return out


def _narrow(array: np.ndarray) -> np.ndarray:
    return array.astype({"f": np.float32, "i": np.int32}.get(array.dtype.kind, array.dtype))


def _wide(array: np.ndarray) -> np.ndarray:
    return array.astype({"f": np.float64, "i": np.int64}.get(array.dtype.kind, array.dtype))


_OF_KERNELS = re.compile(r"epipole\..*_kernels$")
FORMS = (_read_only, _scattered, _swapped, _narrow, _wide) if IS_WHOLE else (_foreign, _narrow, _wide)


def in_form(value: Any, form: Callable[[np.ndarray], np.ndarray]) -> Any:
    """The value with all its arrays in another form; classes that calculate with them put them right."""
    if isinstance(value, np.ndarray):
        return form(value)
    if type(value) in (list, tuple):
        return type(value)(in_form(item, form) for item in value)
    if is_dataclass(value) and not isinstance(value, type):
        return type(value)(**{f.name: in_form(getattr(value, f.name), form) for f in fields(value) if f.init})
    return value


def compiled() -> dict[str, int]:
    """Of each kernel that is loaded the number of types it was compiled for."""
    modules = [(name, module) for name, module in sys.modules.items() if _OF_KERNELS.match(name)]
    return {
        f"{name}.{kernel}": len(value.signatures)
        for name, module in modules
        for kernel, value in list(vars(module).items())
        if hasattr(value, "py_func") and hasattr(value, "signatures")
    }


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("call", CALCULATING, ids=repr)
def test_other_forms_of_arguments_compile_nothing(call: Call) -> None:
    """Read-only, scattered, of either byte order, single or double precision: kernels see one form of them."""
    arguments = dict(call.arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            call.function(**arguments)
        except EpipoleError:  # what writes to a place that is not there
            assert call.name == "write_g2o"
        before = compiled()
        for form in FORMS:
            try:
                call.function(**{name: in_form(value, form) for name, value in arguments.items()})
            except EpipoleError as error:
                # Single precision leaves nothing of what distinguishes a rotation's or a rig's numbers.
                assert form is _narrow or call.name == "write_g2o", f"{form.__name__}: {error}"
    after = compiled()
    assert after == before, {name: after[name] for name in after if after[name] != before.get(name)}
