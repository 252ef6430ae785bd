"""The comparison with Python sees differences, knows calls, and leaves everything as it was."""

import math
from types import ModuleType

import numpy as np
import pytest

from epipole._jit import kernel
from epipole.cameras import _camera_kernels, camera
from kernel_references import assert_same, assert_same_as_python, plain_python, record_calls, reference_of


@kernel
def halve_all(values, out):
    for k in range(len(values)):
        out[k] = 0.5 * values[k]
    return len(values)


class Broken:
    """A kernel whose compiled form does something else."""

    def __init__(self, compiled):
        self.py_func, self.compiled = getattr(halve_all, "py_func", halve_all), compiled

    def __call__(self, values, out):
        return self.compiled(values, out)


def test_equal_is_equal(rng):
    values, out = rng.normal(size=5), np.zeros(5)
    count, (_, split) = assert_same_as_python(halve_all, values, out)
    assert count == 5 and not out.any()
    np.testing.assert_array_equal(split, values / 2)


@pytest.mark.parametrize(
    "compiled", [lambda values, out: len(values), lambda values, out: halve_all(values, out) + 1]
)
def test_what_is_written_and_what_is_returned_must_be_the_same(rng, compiled):
    with pytest.raises(AssertionError):
        assert_same_as_python(Broken(compiled), rng.normal(size=5), np.zeros(5))


def test_tolerances():
    one, near = np.array([1.0, np.nan]), np.array([1.0 + 1e-9, np.nan])
    with pytest.raises(AssertionError):
        assert_same(near, one)
    assert_same(near, one, rtol=1e-8)
    assert_same((near, 3), (one, 3), of_largest=1e-8)
    with pytest.raises(AssertionError):
        assert_same((near, 3), (one, 4), rtol=1.0)
    with pytest.raises(AssertionError):
        assert_same(one.astype(np.float32), one, rtol=1.0)
    with pytest.raises(AssertionError):
        assert_same(one[:1], one, only_written=True)
    assert_same(np.array([1.0, 7.0]), one, only_written=True)


def test_python_computes_as_kernels_do():
    before, before_math = _camera_kernels.project_one, _camera_kernels.math
    with plain_python():
        assert type(_camera_kernels.project_one).__name__ == "function"
        assert np.isnan(_camera_kernels.math.sqrt(-1.0)) and _camera_kernels.math.log(0.0) == -np.inf
        assert 1.0 / _camera_kernels.math.sqrt(0.0) == math.inf
    assert _camera_kernels.project_one is before and _camera_kernels.math is before_math


def test_calls_are_noted_and_undone(rng):
    points = rng.uniform(1.0, 2.0, (3, 3))
    pinhole = camera.Camera(camera.CameraModel.PINHOLE, 9, 9, np.array([5.0, 5.0, 4.0, 4.0]))
    kernels = camera.kernels
    with pytest.MonkeyPatch.context() as patch:
        calls = record_calls(patch, camera, _camera_kernels.project_all)
        pixels = pinhole.project(points)
    np.testing.assert_array_equal(calls[0][2], points)
    np.testing.assert_array_equal(pinhole.project(points), pixels)
    assert camera.kernels is kernels and len(calls) == 1
    with pytest.raises(AssertionError, match="does not call"):
        record_calls(patch, ModuleType("empty"), _camera_kernels.project_all)


def test_marks_add_up():
    @reference_of(halve_all)
    @reference_of(_camera_kernels.project_all)
    def test():
        pass

    assert test.reference_of == (_camera_kernels.project_all, halve_all)
