"""Bundle adjusters with a common interface: `solve(task, limits)` returns a solution, and each runs in its own process.

All minimize the same sum from the same start and stop only at the same relative decrease. Only GTSAM fixes the gauge (by priors).
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import metadata
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, Literal

import numpy as np

from benchmarks.tasks.bundle import BundleTask, LossName, cost, ring_task

_THREAD_VARIABLES = ("EPIPOLE_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_MAX_COST_DIFFERENCE = 1e-6
"""Relative difference between a library's own final cost and ours above which the message mentions it."""


@dataclass(frozen=True, slots=True)
class BundleLimits:
    """Limits that are the same for every library."""

    loss: LossName = "trivial"
    loss_scale_px: float = 1.0
    max_iterations: int = 100
    function_tolerance: float = 1e-6
    """Stop when the relative decrease of the cost in one step is smaller."""
    num_threads: int = 1


@dataclass(frozen=True, slots=True)
class BundleRun:
    """Time and cost of one library on one task."""

    seconds_build: float
    """Time to convert the arrays into the library's own problem."""
    seconds_solve: float
    initial_cost: float
    final_cost: float
    num_iterations: int
    """Linear solves, including the last one (GTSAM: accepted steps)."""
    costs_over_time: list[tuple[float, float]] | None
    """(seconds since the start of the solve, the library's own cost) after each iteration."""
    message: str


@dataclass(frozen=True, slots=True, eq=False)
class BundleSolution:
    """Result of a library; arrays as in `BundleTask`."""

    rotation: np.ndarray
    translation: np.ndarray
    params: np.ndarray
    points: np.ndarray
    seconds_build: float
    seconds_solve: float
    num_iterations: int
    own_cost: float
    message: str
    costs_over_time: list[tuple[float, float]] | None = None


class BundlePeer(ABC):
    """A library. `solve` runs in a new process."""

    name: str
    package: str

    def version(self) -> str | None:
        """The installed version; None if it is not installed."""
        try:
            return metadata.version(self.package)
        except metadata.PackageNotFoundError:
            return None

    @abstractmethod
    def solve(self, task: BundleTask, limits: BundleLimits) -> BundleSolution:
        """Optimize all free parameters of the task."""


class Epipole(BundlePeer):
    """This project."""

    name, package = "epipole", "epipole"

    def solve(self, task: BundleTask, limits: BundleLimits) -> BundleSolution:
        """Optimize all free parameters of the task; compiled code is loaded before the clock starts."""
        small = ring_task(6, 60) if not _has_camera_per_frame(task) else task
        self.adjust(small, replace(limits, max_iterations=1))
        return self.adjust(task, limits)

    def adjust(
        self, task: BundleTask, limits: BundleLimits, *, single_precision: bool = False
    ) -> BundleSolution:
        """`solve` without the warm-up."""
        from epipole.optim import BundleConfig, Loss, adjust_bundle

        start = time.perf_counter()
        problem = self._problem(task)
        config = BundleConfig(
            loss=Loss.HUBER if limits.loss == "huber" else Loss.TRIVIAL,
            loss_scale_px=limits.loss_scale_px,
            max_iterations=limits.max_iterations,
            function_tolerance=limits.function_tolerance,
            single_precision=single_precision,
        )
        built = time.perf_counter()
        found = adjust_bundle(problem, config)
        solved = time.perf_counter()
        params = task.params.copy()
        params[:, : 3 + task.num_distortion] = found.camera_params[:, : 3 + task.num_distortion]
        return BundleSolution(
            rotation=found.rig_from_world.rotation,
            translation=found.rig_from_world.translation,
            params=params,
            points=found.points_in_world,
            seconds_build=built - start,
            seconds_solve=solved - built,
            num_iterations=found.num_iterations,
            own_cost=found.final_cost,
            message=f"{found.reason.value}, {found.solver.value}",
            costs_over_time=[(0.0, found.initial_cost), *((i.seconds, i.cost) for i in found.history)],
        )

    def _problem(self, task: BundleTask) -> Any:
        from epipole.cameras import MAX_PARAMS, CameraModel
        from epipole.geometry import Rigid3
        from epipole.optim import BundleProblem, free_params_mask

        model = CameraModel.RADIAL if task.num_distortion == 2 else CameraModel.SIMPLE_RADIAL
        models = np.full(len(task.params), int(model), np.int32)
        params = np.zeros((len(task.params), MAX_PARAMS))
        params[:, : 3 + task.num_distortion] = task.params[:, : 3 + task.num_distortion]
        num_frames, num_points = len(task.rotation), len(task.points)
        return BundleProblem(
            rig_from_world=Rigid3(task.rotation, task.translation),
            cam_from_rig=Rigid3.identity(1),
            camera_model=models,
            camera_params=params,
            points_in_world=task.points,
            offsets=np.searchsorted(task.point, np.arange(num_points + 1)).astype(np.int64),
            frame=task.frame,
            sensor=np.zeros(len(task.frame), np.int32),
            camera=task.camera_of_frame[task.frame],
            pixels=task.pixels,
            frame_free=np.ones((num_frames, 6)),
            params_free=free_params_mask(models),
            point_free=np.ones(num_points),
        )


class _ColmapProblem:
    """A task as a pycolmap reconstruction with its bundle adjuster; COLMAP's ids are our indices plus one."""

    def __init__(self, task: BundleTask, limits: BundleLimits) -> None:
        import pycolmap

        self.task = task
        self.reconstruction = _colmap_reconstruction(task)
        self.options = _colmap_options(limits)
        self.config = pycolmap.BundleAdjustmentConfig()
        for f in range(len(task.rotation)):
            self.config.add_image(f + 1)
        self.adjuster = pycolmap.create_default_ceres_bundle_adjuster(
            self.options, self.config, self.reconstruction
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """Poses, camera parameters and points of the reconstruction."""
        task, found = self.task, self.reconstruction
        motion = np.array([found.image(f + 1).cam_from_world().matrix() for f in range(len(task.rotation))])
        params = task.params.copy()
        for c in range(len(params)):
            params[c, : 3 + task.num_distortion] = found.camera(c + 1).params
        points = np.empty_like(task.points)
        for j in range(len(points)):
            points[j] = found.point3D(j + 1).xyz
        return {
            "rotation": motion[:, :, :3],
            "translation": motion[:, :, 3],
            "params": params,
            "points": points,
        }


def _colmap_reconstruction(task: BundleTask) -> Any:
    import pycolmap

    out = pycolmap.Reconstruction()
    model = "RADIAL" if task.num_distortion == 2 else "SIMPLE_RADIAL"
    for c, params in enumerate(task.params):
        width, height = (max(1, round(2.0 * center)) for center in params[1:3])
        values = params[: 3 + task.num_distortion]
        out.add_camera_with_trivial_rig(
            pycolmap.Camera(model=model, width=width, height=height, params=values, camera_id=c + 1)
        )
    by_frame = np.argsort(task.frame, kind="stable")
    ends = np.cumsum(np.bincount(task.frame, minlength=len(task.rotation)))
    index_in_image = np.empty(len(by_frame), np.int64)
    for f, rows in enumerate(np.split(by_frame, ends[:-1])):
        index_in_image[rows] = np.arange(len(rows))
        camera = int(task.camera_of_frame[f]) + 1
        image = pycolmap.Image(name=str(f), keypoints=task.pixels[rows], camera_id=camera, image_id=f + 1)
        motion = np.column_stack([task.rotation[f], task.translation[f]])
        out.add_image_with_trivial_frame(image, pycolmap.Rigid3d(motion))
    _add_colmap_points(out, task, index_in_image)
    return out


def _add_colmap_points(out: Any, task: BundleTask, index_in_image: np.ndarray) -> None:
    from pycolmap import Track, TrackElement

    offsets = np.searchsorted(task.point, np.arange(len(task.points) + 1)).tolist()
    for j, xyz in enumerate(task.points):
        rows = slice(offsets[j], offsets[j + 1])
        seen = zip((task.frame[rows] + 1).tolist(), index_in_image[rows].tolist())
        identifier = out.add_point3D(xyz, Track([TrackElement(image, index) for image, index in seen]))
        if identifier != j + 1:
            raise RuntimeError(f"pycolmap gave point {j} the id {identifier}, not {j + 1}.")


def _colmap_options(limits: BundleLimits) -> Any:
    import pycolmap

    out = pycolmap.BundleAdjustmentOptions()
    out.refine_focal_length = out.refine_extra_params = True
    out.refine_principal_point = out.print_summary = False
    out.ceres.loss_function_type = getattr(pycolmap.LossFunctionType, limits.loss.upper())
    out.ceres.loss_function_scale = limits.loss_scale_px
    _limit_ceres(out.ceres.solver_options, limits)
    return out


def _limit_ceres(options: Any, limits: BundleLimits) -> None:
    options.max_num_iterations = limits.max_iterations
    options.function_tolerance = limits.function_tolerance
    options.gradient_tolerance = options.parameter_tolerance = 0.0
    options.num_threads = limits.num_threads


def _ceres_message(summary: Any) -> str:
    """Reason for stopping, and linear solver."""
    return f"{summary.termination_type.name}, {summary.linear_solver_type_used.name}: {summary.message}"


class Pycolmap(BundlePeer):
    """COLMAP's bundle adjuster (Ceres) through pycolmap, with the linear solver that COLMAP selects for the size."""

    name, package = "pycolmap", "pycolmap"

    def solve(self, task: BundleTask, limits: BundleLimits) -> BundleSolution:
        """Optimize all free parameters of the task."""
        from pycolmap.pyceres import LoggingType

        start = time.perf_counter()
        problem = _ColmapProblem(task, limits)
        built = time.perf_counter()
        # pycolmap has no callback for Ceres' progress, so it is parsed from standard output.
        solver = problem.adjuster.options.ceres.solver_options
        solver.logging_type = LoggingType.PER_MINIMIZER_ITERATION
        solver.minimizer_progress_to_stdout = True
        with _standard_output() as lines:
            solve_start = time.perf_counter()
            solved: Any = problem.adjuster.solve()
            seconds = time.perf_counter() - solve_start
        summary, progress = solved.ceres_summary, _ceres_progress(lines)
        return BundleSolution(
            **problem.arrays(),
            seconds_build=built - start,
            seconds_solve=seconds,
            num_iterations=summary.num_linear_solves,
            own_cost=summary.final_cost,
            message=_ceres_message(summary),
            costs_over_time=[*progress, (summary.total_time_in_seconds, summary.final_cost)],
        )


@contextmanager
def _standard_output() -> Iterator[list[str]]:
    """Capture the lines that this process, including C++ code, writes to standard output."""
    lines: list[str] = []
    sys.stdout.flush()
    before = os.dup(1)
    with tempfile.TemporaryFile("w+", encoding="utf-8") as file:
        os.dup2(file.fileno(), 1)
        try:
            yield lines
        finally:
            os.dup2(before, 1)
            os.close(before)
            file.seek(0)
            lines.extend(file)


def _ceres_progress(lines: list[str]) -> list[tuple[float, float]]:
    """(total time, cost) of each row in Ceres' table of iterations."""
    rows = [line.split() for line in lines]
    return [(float(row[-1]), float(row[1])) for row in rows if len(row) == 10 and row[0].isdecimal()]


LinearSolver = Literal["DENSE_SCHUR", "SPARSE_SCHUR", "ITERATIVE_SCHUR"]


class Pyceres(BundlePeer):
    """The Ceres Solver through pyceres on COLMAP's cost functions, with a given linear solver.

    pycolmap builds the problem, because pyceres has no manifold for COLMAP's poses of seven numbers. Both packages must
    be built with the same version of Ceres.
    """

    package = "pyceres"

    def __init__(self, linear_solver: LinearSolver) -> None:
        self.linear_solver = linear_solver
        self.name = f"pyceres-{linear_solver}"

    def solve(self, task: BundleTask, limits: BundleLimits) -> BundleSolution:
        """Optimize all free parameters of the task."""
        import pyceres  # before pycolmap, whose problems then have pyceres' type
        import pycolmap

        if pyceres.__ceres_version__ != pycolmap.__ceres_version__:
            raise RuntimeError(
                f"pyceres was built with Ceres {pyceres.__ceres_version__} and pycolmap with "
                f"{pycolmap.__ceres_version__}: install builds with the same version."
            )
        start = time.perf_counter()
        problem = _ColmapProblem(task, limits)
        ceres_problem = problem.adjuster.problem
        built = time.perf_counter()
        options, progress = self._options(limits)
        summary = pyceres.SolverSummary()
        pyceres.solve(options, ceres_problem, summary)
        seconds = time.perf_counter() - built
        return BundleSolution(
            **problem.arrays(),
            seconds_build=built - start,
            seconds_solve=seconds,
            num_iterations=summary.num_linear_solves,
            own_cost=summary.final_cost,
            message=_ceres_message(summary),
            costs_over_time=[*progress, (summary.total_time_in_seconds, summary.final_cost)],
        )

    def _options(self, limits: BundleLimits) -> tuple[Any, list[tuple[float, float]]]:
        """Options, and a list that the solve fills with (time, cost)."""
        import pyceres

        progress: list[tuple[float, float]] = []

        class RecordProgress(pyceres.IterationCallback):
            def __call__(self, iteration: Any) -> Any:
                progress.append((iteration.cumulative_time_in_seconds, iteration.cost))
                return pyceres.CallbackReturnType.SOLVER_CONTINUE

        out = pyceres.SolverOptions()
        out.linear_solver_type = getattr(pyceres.LinearSolverType, self.linear_solver)
        if self.linear_solver == "ITERATIVE_SCHUR":
            out.preconditioner_type = pyceres.PreconditionerType.SCHUR_JACOBI
        _limit_ceres(out, limits)
        out.callbacks = [RecordProgress()]
        return out, progress


class Gtsam(BundlePeer):
    """GTSAM's Levenberg-Marquardt with default options: the general variant, or that for structure from motion."""

    package = "gtsam"
    _GAUGE_PRECISION = 1e10
    """Precision of the priors that fix the gauge; weaker ones slow convergence."""
    _FIXED_PRECISION = 1e12
    """Precision of the priors that fix k2."""

    def __init__(self, optimizer: Literal["LevenbergMarquardt", "SfmLevenbergMarquardt"]) -> None:
        self.optimizer = optimizer
        self.name = f"gtsam-{optimizer}"

    def solve(self, task: BundleTask, limits: BundleLimits) -> BundleSolution:
        """Optimize all free parameters of the task."""
        if hasattr(os, "sched_setaffinity"):  # GTSAM has no option for the number of threads
            os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: limits.num_threads])
        import gtsam

        start = time.perf_counter()
        graph, values = _gtsam_graph(task, limits), _gtsam_values(task)
        self._add_priors(graph, values, task)
        params = getattr(gtsam, f"{self.optimizer}Params")()
        params.setMaxIterations(limits.max_iterations)
        params.setRelativeErrorTol(limits.function_tolerance)
        params.setAbsoluteErrorTol(0.0)
        progress = [(0.0, graph.error(values))]
        built = time.perf_counter()
        params.iterationHook = lambda _number, _before, after: progress.append(
            (time.perf_counter() - built, after)
        )
        optimizer = getattr(gtsam, f"{self.optimizer}Optimizer")(graph, values, params)
        found = optimizer.optimize()
        seconds = time.perf_counter() - built
        return BundleSolution(
            **_gtsam_arrays(task, found),
            seconds_build=built - start,
            seconds_solve=seconds,
            num_iterations=optimizer.iterations(),
            own_cost=graph.error(found),
            message=f"lambda {optimizer.lambda_():.0e}",
            costs_over_time=progress,
        )

    def _add_priors(self, graph: Any, values: Any, task: BundleTask) -> None:
        """Fix one pose and one coordinate of another one's position, as COLMAP does, and k2 if the task fixes it."""
        import gtsam

        per_frame = _has_camera_per_frame(task)
        precisions = np.zeros((len(task.rotation), 9))
        first, second, axis = _gauge(task)
        precisions[first, :6] = precisions[second, 3 + axis] = self._GAUGE_PRECISION
        if per_frame and task.num_distortion == 1:
            precisions[:, 8] = self._FIXED_PRECISION
        noise = gtsam.noiseModel.Diagonal.Precisions
        for f in np.flatnonzero(precisions.any(axis=1)):
            key = gtsam.symbol("x", f)
            if per_frame:
                camera = values.atPinholeCameraCal3Bundler(key)
                graph.add(gtsam.PriorFactorPinholeCameraCal3Bundler(key, camera, noise(precisions[f])))
            else:
                graph.add(gtsam.PriorFactorPose3(key, values.atPose3(key), noise(precisions[f, :6])))
        if not per_frame and task.num_distortion == 1:
            fixed = noise(np.array([0.0, 0.0, self._FIXED_PRECISION]))
            for c in range(len(task.params)):
                key = gtsam.symbol("k", c)
                graph.add(gtsam.PriorFactorCal3Bundler(key, values.atCal3Bundler(key), fixed))


def _has_camera_per_frame(task: BundleTask) -> bool:
    """Whether each frame has its own camera, which GTSAM stores in one variable with the pose."""
    return np.array_equal(task.camera_of_frame, np.arange(len(task.params)))


def _gauge(task: BundleTask) -> tuple[int, int, int]:
    """The frame with the most observations, the one farthest from it, and the latter's axis closest to their baseline."""
    centers = -np.einsum("fji,fj->fi", task.rotation, task.translation)
    first = int(np.argmax(np.bincount(task.frame)))
    second = int(np.argmax(np.linalg.norm(centers - centers[first], axis=1)))
    along = task.rotation[second] @ (centers[second] - centers[first])
    return first, second, int(np.argmax(np.abs(along)))


def _gtsam_graph(task: BundleTask, limits: BundleLimits) -> Any:
    import gtsam

    noise: Any = gtsam.noiseModel.Unit.Create(2)
    if limits.loss == "huber":
        huber = gtsam.noiseModel.mEstimator.Huber.Create(limits.loss_scale_px)
        noise = gtsam.noiseModel.Robust.Create(huber, noise)
    graph = gtsam.NonlinearFactorGraph()
    x, landmark, k = (gtsam.symbol(letter, 0) for letter in "xlk")
    rows = zip(task.frame.tolist(), task.point.tolist(), task.pixels)
    if _has_camera_per_frame(task):
        for f, j, pixel in rows:
            graph.push_back(gtsam.GeneralSFMFactorCal3Bundler(pixel, noise, x + f, landmark + j))
    else:
        camera_of_frame = task.camera_of_frame.tolist()
        for f, j, pixel in rows:
            keys = (x + f, landmark + j, k + camera_of_frame[f])
            graph.push_back(gtsam.GeneralSFMFactor2Cal3Bundler(pixel, noise, *keys))
    return graph


def _gtsam_values(task: BundleTask) -> Any:
    import gtsam

    values = gtsam.Values()
    cameras = [gtsam.Cal3Bundler(f, k1, k2, cx, cy) for f, cx, cy, k1, k2 in task.params.tolist()]
    per_frame = _has_camera_per_frame(task)
    for f, (rotation, translation) in enumerate(zip(task.rotation, task.translation)):
        pose = gtsam.Pose3(gtsam.Rot3(rotation), translation).inverse()
        key = gtsam.symbol("x", f)
        values.insert(key, gtsam.PinholeCameraCal3Bundler(pose, cameras[f]) if per_frame else pose)
    if not per_frame:
        for c, camera in enumerate(cameras):
            values.insert(gtsam.symbol("k", c), camera)
    first = gtsam.symbol("l", 0)
    for j, point in enumerate(task.points):
        values.insertPoint3(first + j, point)
    return values


def _gtsam_arrays(task: BundleTask, values: Any) -> dict[str, np.ndarray]:
    import gtsam

    keys = [gtsam.symbol("x", f) for f in range(len(task.rotation))]
    if _has_camera_per_frame(task):
        cameras = [values.atPinholeCameraCal3Bundler(key) for key in keys]
        poses, calibrations = [c.pose() for c in cameras], [c.calibration() for c in cameras]
    else:
        poses = [values.atPose3(key) for key in keys]
        calibrations = [values.atCal3Bundler(gtsam.symbol("k", c)) for c in range(len(task.params))]
    motion = np.array([pose.inverse().matrix()[:3] for pose in poses])
    params, free = task.params.copy(), [0, 3, 4][: 1 + task.num_distortion]
    params[:, free] = np.array([(c.fx(), c.k1(), c.k2()) for c in calibrations])[:, : len(free)]
    points, first = np.empty_like(task.points), gtsam.symbol("l", 0)
    for j in range(len(points)):
        points[j] = values.atPoint3(first + j)
    return {"rotation": motion[:, :, :3], "translation": motion[:, :, 3], "params": params, "points": points}


PEERS: tuple[BundlePeer, ...] = (
    Epipole(),
    Pycolmap(),
    Pyceres("DENSE_SCHUR"),
    Pyceres("SPARSE_SCHUR"),
    Pyceres("ITERATIVE_SCHUR"),
    Gtsam("LevenbergMarquardt"),
    Gtsam("SfmLevenbergMarquardt"),
)


def run_peer(
    peer: BundlePeer, task: BundleTask, limits: BundleLimits, timeout_s: float | None = None
) -> BundleRun | str:
    """Solve a task in a new process; a string is the reason for a failure."""
    if peer.version() is None:
        return f"{peer.package} is not installed"
    context = get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(peer, task, limits, theirs), daemon=True)
    with _thread_variables(limits.num_threads):
        process.start()
    theirs.close()
    try:
        return ours.recv() if ours.poll(timeout_s) else f"did not finish within {timeout_s:.0f} s"
    except EOFError:
        process.join(10)
        return f"the process ended with exit code {process.exitcode}"
    finally:
        process.kill()
        process.join()


@contextmanager
def _thread_variables(num_threads: int) -> Iterator[None]:
    """Set the environment variables that libraries read at import, for processes started in this context."""
    before = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, str(num_threads)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _serve(peer: BundlePeer, task: BundleTask, limits: BundleLimits, connection: Connection) -> None:
    try:
        connection.send(_evaluated(task, limits, peer.solve(task, limits)))
    except Exception as error:  # noqa: BLE001 - any exception of a peer is a failure
        connection.send(repr(error))


def _evaluated(task: BundleTask, limits: BundleLimits, found: BundleSolution) -> BundleRun:
    def cost_of(*arrays: np.ndarray) -> float:
        return cost(task, *arrays, loss=limits.loss, loss_scale_px=limits.loss_scale_px)

    final = cost_of(found.rotation, found.translation, found.params, found.points)
    message = found.message
    if not abs(final - found.own_cost) <= _MAX_COST_DIFFERENCE * final:
        message += f"; its own final cost is {found.own_cost:.9g}"
    return BundleRun(
        seconds_build=found.seconds_build,
        seconds_solve=found.seconds_solve,
        initial_cost=cost_of(task.rotation, task.translation, task.params, task.points),
        final_cost=final,
        num_iterations=found.num_iterations,
        costs_over_time=found.costs_over_time,
        message=message,
    )
