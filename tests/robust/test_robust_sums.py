"""Sums do not depend on where arrays are in memory."""

import ast
from pathlib import Path

import numpy as np
import pytest

import epipole
from epipole.geometry import Rigid3, Rotation3
from epipole.robust._absolute_pose_kernels import _rows_of_block as rows_of_ray_pose
from epipole.robust.pairs._fundamental_kernels import _rows_of_block as rows_of_fundamental
from epipole.robust.pairs._homography_kernels import _rows_of_block as rows_of_homography
from epipole.robust.pairs._relative_pose_kernels import _rows_of_block as rows_of_motion
from epipole.robust.pairs._wide_motion_kernels import _rows_of_block as rows_of_wide_motion
from epipole.solvers._two_view_kernels import essential_from_motion

SOURCES = Path(epipole.__file__).parent


def _reassociating_functions():
    for path in sorted(SOURCES.rglob("*.py")):
        if "reassoc" not in (text := path.read_text()).lower():
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef) and any(
                "reassoc" in ast.unparse(one).lower() for one in node.decorator_list
            ):
                yield pytest.param(node, id=f"{path.stem}.{node.name}")


@pytest.mark.parametrize("function", list(_reassociating_functions()))
def test_sums_in_any_order_are_taken_in_loops_that_only_read(function):
    """Of a loop that writes, LLVM keeps two versions, and chooses one by the distance of the arrays; helpers join such loops."""
    loops = [node for node in ast.walk(function) if isinstance(node, ast.For)]
    assert loops
    for loop in loops:
        written = [n for n in ast.walk(loop) if isinstance(n, ast.Subscript) and isinstance(n.ctx, ast.Store)]
        assert not written


@pytest.mark.parametrize(
    ("rows_of", "height", "width"),
    [
        (rows_of_motion, 11, 4),
        (rows_of_fundamental, 11, 4),
        (rows_of_homography, 21, 4),
        (rows_of_wide_motion, 11, 18),
        (rows_of_ray_pose, 15, 15),
    ],
)
def test_rows_are_the_same_wherever_the_arrays_are(rows_of, height, width, rng):
    model = np.zeros(32)
    motion = Rigid3(Rotation3.exp(0.3 * rng.normal(size=3)).matrix, np.array([0.6, 0.0, 0.8]))
    model[:9], model[9:12] = motion.rotation.ravel(), motion.translation
    if rows_of in (rows_of_motion, rows_of_wide_motion):
        essential_from_motion(model, model[12:21])
    memory = np.zeros(width * 128 + height * 128 + 1000)
    for count in (17, 30, 61, 128):
        values, expected = 0.4 * rng.normal(size=(width, count)), None
        for gap in (900, *range(9)):
            items = memory[: width * count].reshape(width, count)
            rows = memory[width * count + gap :][: height * 128].reshape(height, 128)
            items[:], rows[:] = values, 0.0
            rows_of(model, items, 1e3, 1.0, 0, count, rows)
            expected = rows.copy() if expected is None else expected
            np.testing.assert_array_equal(rows, expected)
    assert np.count_nonzero(expected) > count
