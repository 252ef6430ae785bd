"""Minimal solvers: time per call, and how often the true solution is among the results. `python -m benchmarks.solvers`.

`loop` is the time in a compiled loop, as in the robust estimators; `call` is that of the public function. PoseLib is called
from Python in the same process.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from epipole import solvers
from epipole.geometry import Rigid3, essential_from_cam2_from_cam1, from_homogeneous
from epipole.solvers import _absolute_pose_kernels as absolute
from epipole.solvers import _five_point_kernels as five_point
from epipole.solvers import _focal_motion_kernels as focal_motion
from epipole.solvers import _more_pose_kernels as more
from epipole.solvers import _two_view_kernels as two_view

MAX_DIFFERENCE = 1e-5
"""Largest difference between the elements of a correct matrix and the true one, both with norm 1."""
VERTICAL = np.array([0.0, 1.0, 0.0])

Columns = tuple[np.ndarray, ...]


@dataclass(frozen=True)
class Case:
    """A solver, its problems, and PoseLib's solver for them."""

    name: str
    columns: Columns
    """Arguments, one row per problem."""
    truth: np.ndarray
    """(n, 3, 3) matrices."""
    call: Callable[..., Iterable[np.ndarray]]
    """Solves one problem from Python and returns all solutions."""
    loop: Callable[..., None]
    """Solves all problems in a compiled loop."""
    poselib: Callable[[Any], Callable[..., Iterable[np.ndarray]]] | None = None
    """Takes the module `poselib` and returns a function like `call`."""


@numba.njit
def _five_point(y1, y2, out, w):
    for n in range(len(y1)):
        five_point.essential_five_point(y1[n], y2[n], out, w)


@numba.njit
def _seven_point(x1, x2, out, w):
    for n in range(len(x1)):
        two_view.fundamental_seven_point(x1[n], x2[n], out, w)


@numba.njit
def _four_point(x1, x2, out):
    for n in range(len(x1)):
        two_view.homography_four_point(x1[n], x2[n], out)


@numba.njit
def _six_point(x1, x2, out, focals, w):
    for n in range(len(x1)):
        focal_motion.shared_focal_six_point(x1[n], x2[n], out, focals, w)


@numba.njit
def _upright_three_point(y1, y2, out, w):
    for n in range(len(y1)):
        more.upright_relative_three_point(y1[n], y2[n], out, w)


@numba.njit
def _p3p(rays, points, out, w):
    for n in range(len(rays)):
        absolute.p3p(rays[n], points[n], out, w)


@numba.njit
def _p4pf(pixels, points, out, w):
    for n in range(len(pixels)):
        more.p4pf(pixels[n], points[n], out, w)


@numba.njit
def _gp3p(origins, rays, points, out, w):
    for n in range(len(rays)):
        more.generalized_p3p(origins[n], rays[n], points[n], out, w)


@numba.njit
def _p2p(rays, points, out):
    for n in range(len(rays)):
        more.upright_p2p(rays[n], points[n], out)


def _motions(rng: np.random.Generator, count: int, upright: bool = False) -> Rigid3:
    rotations = (
        rng.uniform(-1.0, 1.0, (count, 1)) * VERTICAL if upright else 0.4 * rng.standard_normal((count, 3))
    )
    motion = Rigid3.exp(np.concatenate([rng.standard_normal((count, 3)), rotations], axis=1))
    return Rigid3(
        motion.rotation, motion.translation / np.linalg.norm(motion.translation, axis=1, keepdims=True)
    )


def _seen(rng: np.random.Generator, motion: Rigid3, points: int) -> Columns:
    """Random points in the coordinates of both cameras, in front of both."""
    x1 = rng.uniform(-1, 1, (len(motion), points, 3)) * [2, 2, 1] + [0, 0, 6]
    return x1, np.einsum("nij,nkj->nki", motion.rotation, x1) + motion.translation[:, None]


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def _on_plane(x: np.ndarray) -> np.ndarray:
    return x / x[..., 2:]


def two_view_cases(rng: np.random.Generator, count: int) -> list[Case]:
    """Cases for two views: 5, 7, 4 and 6 points, and 3 points with a known vertical."""
    motion = _motions(rng, count)
    essential = essential_from_cam2_from_cam1(motion) / np.sqrt(2.0)
    five, seven = _seen(rng, motion, 5), _seen(rng, motion, 7)
    flat = tuple(_on_plane(x) for x in seven)
    camera = np.diag([1.0, 1.0, 1.3])  # proportional to the inverse of K, with a focal length of 1.3
    six = tuple(_on_plane(x) * [1.3, 1.3, 1.0] for x in _seen(rng, motion, 6))
    fundamental = camera @ essential @ camera
    upright = _motions(rng, count, upright=True)
    three = _seen(rng, upright, 3)
    homography = np.eye(3) + 0.15 * rng.standard_normal((count, 3, 3))
    corners = np.array(
        [[-0.5, -0.5, 1], [0.5, -0.5, 1], [0.5, 0.5, 1], [-0.5, 0.5, 1.0]]
    ) + 0.1 * rng.standard_normal((count, 4, 3))
    quadrangle = _on_plane(corners)
    moved = _on_plane(np.einsum("nij,nkj->nki", homography, quadrangle))
    return [
        Case(
            "essential, 5 points", five, essential, solvers.solve_essential_five_point,
            lambda a, b: _five_point(a, b, np.empty((10, 9)), five_point.five_point_workspace()),
            lambda p: lambda a, b: p.essential_matrix_5pt(_unit(a), _unit(b)),
        ),
        Case(
            "fundamental, 7 points", flat, essential,
            lambda a, b: solvers.solve_fundamental_seven_point(a[:, :2], b[:, :2]),
            lambda a, b: _seven_point(a, b, np.empty((3, 9)), two_view.seven_point_workspace()),
        ),
        Case(
            "homography, 4 points", (quadrangle, moved), homography,
            lambda a, b: solvers.solve_homography_four_point(a[:, :2], b[:, :2]),
            lambda a, b: _four_point(a, b, np.empty(9)),
        ),
        Case(
            "one focal length, 6 points", six, fundamental,
            lambda a, b: solvers.solve_shared_focal_six_point(a[:, :2], b[:, :2]).fundamental,
            lambda a, b: _six_point(a, b, np.empty((8, 9)), np.empty(8), focal_motion.shared_focal_workspace()),
            lambda p: lambda a, b: [_matrix_of(q) for q in p.shared_focal_relpose_6pt(_unit(a), _unit(b))],
        ),
        Case(
            "upright motion, 3 points", three, upright.rotation,
            lambda a, b: solvers.solve_upright_relative_three_point(a, b).rotation,
            lambda a, b: _upright_three_point(a, b, np.empty((12, 12)), more.upright_relative_workspace()),
            lambda p: lambda a, b: [q.R for q in p.relpose_upright_3pt(_unit(a), _unit(b))],
        ),
    ]  # fmt: skip


def _matrix_of(pair: Any) -> np.ndarray:
    camera = np.diag([1.0, 1.0, pair.camera1.params[0]])
    t = np.asarray(pair.pose.t)
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return camera @ cross @ np.asarray(pair.pose.R) @ camera


def absolute_cases(rng: np.random.Generator, count: int) -> list[Case]:
    """Cases for absolute poses: 3 and 4 points, 3 points of a rig, and 2 points with a known vertical."""
    motion, upright = _motions(rng, count), _motions(rng, count, upright=True)
    three, four, two = _seen(rng, motion, 3), _seen(rng, motion, 4), _seen(rng, upright, 2)
    pixels = 1.3 * from_homogeneous(four[1])
    origins = 0.3 * rng.standard_normal((count, 3, 3))
    return [
        Case(
            "pose, 3 points", (_unit(three[1]), three[0]), motion.rotation,
            lambda y, x: solvers.solve_p3p(x, y).rotation,
            lambda y, x: _p3p(y, x, np.empty((4, 12)), absolute.p3p_workspace()),
            lambda p: lambda y, x: [q.R for q in p.p3p(y, x)],
        ),
        Case(
            "pose and focal length, 4 points", (pixels, four[0]), motion.rotation,
            lambda y, x: solvers.solve_p4pf(x, y).cam_from_world.rotation,
            lambda y, x: _p4pf(y, x - x.mean(axis=1, keepdims=True), np.empty((8, 13)), more.p4pf_workspace()),
            lambda p: lambda y, x: [q.R for q in p.p4pf(y, x, True)[0]],
        ),
        Case(
            "pose of a rig, 3 points", (origins, _unit(three[1] - origins), three[0]), motion.rotation,
            lambda o, y, x: solvers.solve_generalized_p3p(x, o, y).rotation,
            lambda o, y, x: _gp3p(o, y, x, np.empty((8, 13)), more.generalized_p3p_workspace()),
            lambda p: lambda o, y, x: [q.R for q in p.gp3p(o, y, x)],
        ),
        Case(
            "upright pose, 2 points", (_unit(two[1]), two[0]), upright.rotation,
            lambda y, x: solvers.solve_upright_p2p(x, y).rotation,
            lambda y, x: _p2p(y, x, np.empty((2, 12))),
            lambda p: lambda y, x: [q.R for q in p.up2p(y, x)],
        ),
    ]  # fmt: skip


def _microseconds(run: Callable[[], object], count: int, rounds: int) -> float:
    run()
    seconds = []
    for _ in range(rounds):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return 1e6 * float(np.median(seconds)) / count


def _fraction_correct(case: Case, call: Callable[..., Iterable[np.ndarray]]) -> float:
    """Fraction of the problems with the true matrix among the solutions, up to sign."""
    correct = 0
    for n, truth in enumerate(case.truth):
        true = truth / np.linalg.norm(truth)
        found = [np.asarray(m) / np.linalg.norm(m) for m in call(*(c[n] for c in case.columns))]
        correct += (
            min((min(np.abs(m - true).max(), np.abs(m + true).max()) for m in found), default=1.0)
            < MAX_DIFFERENCE
        )
    return correct / len(case.truth)


def measure(case: Case, poselib: Any, rounds: int) -> dict[str, float]:
    """Time per call and fraction of correct results of one solver."""
    count = len(case.truth)
    columns = [np.ascontiguousarray(c) for c in case.columns]

    def for_all(call: Callable[..., object]) -> Callable[[], object]:
        return lambda: [call(*row) for row in zip(*columns)]

    row = {
        "loop us": _microseconds(lambda: case.loop(*columns), count, rounds),
        "call us": _microseconds(for_all(case.call), count, rounds),
        "right": _fraction_correct(case, case.call),
    }
    if poselib is not None and case.poselib is not None:
        theirs = case.poselib(poselib)
        row |= {
            "PoseLib call us": _microseconds(for_all(theirs), count, rounds),
            "PoseLib right": _fraction_correct(case, theirs),
        }
    return row


def main() -> None:
    """Measure every solver, print the table and write the results."""
    parser = argparse.ArgumentParser(description="Minimal solvers.")
    parser.add_argument("--count", type=int, default=2000, help="problems per solver")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    arguments = parser.parse_args()
    try:
        import poselib
    except ImportError:
        poselib = None
    rng = np.random.default_rng(0)
    cases = two_view_cases(rng, arguments.count) + absolute_cases(rng, arguments.count)
    report = {"machine": describe_machine(1), "count": arguments.count}
    report |= {case.name: measure(case, poselib, arguments.rounds) for case in cases}
    arguments.results.mkdir(parents=True, exist_ok=True)
    (arguments.results / "solvers.json").write_text(json.dumps(report, indent=1) + "\n")
    table = Table(title=f"{arguments.count} exact problems")
    columns = ("loop us", "call us", "right", "PoseLib call us", "PoseLib right")
    for column in ("solver", *columns):
        table.add_column(column, justify="right")
    for case in cases:
        row = report[case.name]
        table.add_row(case.name, *(f"{row[c]:.4g}" if c in row else "" for c in columns))
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
