"""Robust estimators with a common interface: a function from problem and limits to a model, run in its own process.

A model is (R, t) for pose problems and a 3 x 3 matrix for F and H; None is a failure.
"""

from __future__ import annotations

import os
import statistics
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from importlib import metadata
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from benchmarks.tasks.estimation import EstimationLimits, EstimationProblem, Kind

Model = tuple[np.ndarray, np.ndarray] | np.ndarray | None
Estimator = Callable[[EstimationProblem, EstimationLimits], Model]
_REPEATS = 3
"""Calls per problem."""
_LONG_ENOUGH_S = 0.1
"""After this time, a problem is not repeated."""


class EstimationPeer(ABC):
    """A library. `estimators` runs in the library's own process."""

    name: str
    package: str

    def version(self) -> str | None:
        """The installed version; None if it is not installed."""
        try:
            return metadata.version(self.package)
        except metadata.PackageNotFoundError:
            return None

    @abstractmethod
    def estimators(self) -> dict[Kind, Estimator]:
        """One function for each kind of problem."""


class Epipole(EstimationPeer):
    """This project."""

    name, package = "epipole", "epipole"

    def estimators(self) -> dict[Kind, Estimator]:
        """One function for each kind of problem."""
        from epipole import robust
        from epipole.cameras import Camera, CameraModel

        def config(limits: EstimationLimits) -> robust.RansacConfig:
            return robust.RansacConfig(
                max_error_px=limits.max_error_px,
                confidence=limits.confidence,
                min_iterations=limits.min_iterations,
                max_iterations=limits.max_iterations,
                min_inlier_ratio=0.0,
                min_inliers=5,
            )

        def camera(p: EstimationProblem) -> Camera:
            return Camera(CameraModel[p.camera], *p.size, np.array(p.params))

        def relative(p: EstimationProblem, limits: EstimationLimits) -> Model:
            c = camera(p)
            found = robust.estimate_relative_pose(p.first, p.second, c, c, config(limits))
            return (found.model.rotation, found.model.translation) if found.success else None

        def absolute(p: EstimationProblem, limits: EstimationLimits) -> Model:
            found = robust.estimate_absolute_pose(p.first, p.second, camera(p), config(limits))
            return (found.model.rotation, found.model.translation) if found.success else None

        def fundamental(p: EstimationProblem, limits: EstimationLimits) -> Model:
            found = robust.estimate_fundamental_matrix(p.first, p.second, config(limits))
            return found.model if found.success else None

        def homography(p: EstimationProblem, limits: EstimationLimits) -> Model:
            found = robust.estimate_homography(p.first, p.second, config(limits))
            return found.model if found.success else None

        return {
            "relative_pose": relative,
            "absolute_pose": absolute,
            "fundamental": fundamental,
            "homography": homography,
        }


class Fastpose(EstimationPeer):
    """fastpose (NumPy and Numba)."""

    name, package = "fastpose", "fastpose"

    def estimators(self) -> dict[Kind, Estimator]:
        """One function for each kind of problem."""
        from fastpose import estimators as e

        def options(limits: EstimationLimits) -> dict[str, Any]:
            return {
                "iterations": limits.max_iterations,
                "min_iterations": limits.min_iterations,
                "max_error": limits.max_error_px,
                "success_prob": limits.confidence,
            }

        def motion(found: tuple[dict, dict]) -> Model:
            model, info = found
            return (model["R"], model["t"]) if info["num_inliers"] else None

        return {
            "relative_pose": lambda p, limits: motion(
                e.estimate_relative_pose(p.first, p.second, camera1=p.K, camera2=p.K, **options(limits))
            ),
            "absolute_pose": lambda p, limits: motion(
                e.estimate_absolute_pose(p.second, p.first, camera=p.K, **options(limits))
            ),
            "fundamental": lambda p, limits: e.estimate_fundamental(p.first, p.second, **options(limits))[0][
                "F"
            ],
            "homography": lambda p, limits: e.estimate_homography(p.first, p.second, **options(limits))[0][
                "H"
            ],
        }


class Poselib(EstimationPeer):
    """PoseLib."""

    name, package = "poselib", "poselib"

    def estimators(self) -> dict[Kind, Estimator]:
        """One function for each kind of problem."""
        import poselib

        def options(limits: EstimationLimits) -> dict[str, Any]:
            return {
                "max_iterations": limits.max_iterations,
                "min_iterations": limits.min_iterations,
                "success_prob": limits.confidence,
                "max_epipolar_error": limits.max_error_px,
                "max_reproj_error": limits.max_error_px,
            }

        def camera(p: EstimationProblem) -> dict[str, Any]:
            return {"model": p.camera, "width": p.size[0], "height": p.size[1], "params": p.params}

        def relative(p: EstimationProblem, limits: EstimationLimits) -> Model:
            found, _ = poselib.estimate_relative_pose(
                p.first, p.second, camera(p), camera(p), options(limits), {}
            )
            return found.R, found.t

        def absolute(p: EstimationProblem, limits: EstimationLimits) -> Model:
            found, _ = poselib.estimate_absolute_pose(p.second, p.first, camera(p), options(limits), {})
            return found.R, found.t

        return {
            "relative_pose": relative,
            "absolute_pose": absolute,
            "fundamental": lambda p, limits: poselib.estimate_fundamental(
                p.first, p.second, options(limits), {}
            )[0],
            "homography": lambda p, limits: poselib.estimate_homography(
                p.first, p.second, options(limits), {}
            )[0],
        }


class OpenCv(EstimationPeer):
    """OpenCV with one of its USAC methods."""

    package = "opencv-python-headless"

    def __init__(self, setting: str) -> None:
        self.setting = setting
        self.name = f"opencv-{setting}"

    def estimators(self) -> dict[Kind, Estimator]:
        """One function for each kind of problem."""
        import cv2

        cv2.setNumThreads(1)
        method = getattr(cv2, self.setting)

        def relative(p: EstimationProblem, limits: EstimationLimits) -> Model:
            E, mask = cv2.findEssentialMat(
                p.first, p.second, p.K, method, limits.confidence, limits.max_error_px, limits.max_iterations
            )
            if E is None or E.shape != (3, 3):
                return None
            _, R, t, _ = cv2.recoverPose(E, p.first, p.second, p.K, mask=mask)
            return R, t[:, 0]

        def absolute(p: EstimationProblem, limits: EstimationLimits) -> Model:
            found, r, t, _ = cv2.solvePnPRansac(
                *(p.first, p.second, p.K, None),
                iterationsCount=limits.max_iterations,
                reprojectionError=limits.max_error_px,
                confidence=limits.confidence,
                flags=method if self.setting.startswith("USAC") else cv2.SOLVEPNP_AP3P,
            )
            return (cv2.Rodrigues(r)[0], t[:, 0]) if found else None

        def fundamental(p: EstimationProblem, limits: EstimationLimits) -> Model:
            return cv2.findFundamentalMat(
                p.first, p.second, method, limits.max_error_px, limits.confidence, limits.max_iterations
            )[0]

        def homography(p: EstimationProblem, limits: EstimationLimits) -> Model:
            return cv2.findHomography(
                *(p.first, p.second, method, limits.max_error_px),
                maxIters=limits.max_iterations,
                confidence=limits.confidence,
            )[0]

        return {
            "relative_pose": relative,
            "absolute_pose": absolute,
            "fundamental": fundamental,
            "homography": homography,
        }


class Pycolmap(EstimationPeer):
    """COLMAP through pycolmap. Its pixel coordinates are shifted by half a pixel, which does not affect the errors."""

    name, package = "pycolmap", "pycolmap"

    def estimators(self) -> dict[Kind, Estimator]:
        """One function for each kind of problem."""
        import pycolmap

        def options(limits: EstimationLimits) -> Any:
            out = pycolmap.RANSACOptions()
            out.max_error, out.confidence = limits.max_error_px, limits.confidence
            out.min_num_trials, out.max_num_trials = limits.min_iterations, limits.max_iterations
            out.random_seed = 0
            return out

        def camera(p: EstimationProblem) -> Any:
            return pycolmap.Camera(model=p.camera, width=p.size[0], height=p.size[1], params=p.params)

        def relative(p: EstimationProblem, limits: EstimationLimits) -> Model:
            found = pycolmap.estimate_essential_matrix(
                p.first, p.second, camera(p), camera(p), options(limits)
            )
            if found is None:
                return None
            motion = found["cam2_from_cam1"]
            return motion.rotation.matrix(), motion.translation

        def absolute(p: EstimationProblem, limits: EstimationLimits) -> Model:
            estimation = pycolmap.AbsolutePoseEstimationOptions()
            estimation.ransac = options(limits)
            found = pycolmap.estimate_and_refine_absolute_pose(p.second, p.first, camera(p), estimation)
            if found is None:
                return None
            return found["cam_from_world"].rotation.matrix(), found["cam_from_world"].translation

        def matrix(estimate: Any, key: str) -> Estimator:
            def run(p: EstimationProblem, limits: EstimationLimits) -> Model:
                found = estimate(p.first, p.second, options(limits))
                return None if found is None else found[key]

            return run

        return {
            "relative_pose": relative,
            "absolute_pose": absolute,
            "fundamental": matrix(pycolmap.estimate_fundamental_matrix, "F"),
            "homography": matrix(pycolmap.estimate_homography_matrix, "H"),
        }


class Pydegensac(EstimationPeer):
    """DEGENSAC and LO-RANSAC by their authors."""

    name, package = "pydegensac", "pydegensac"

    def estimators(self) -> dict[Kind, Estimator]:
        """One function for each kind of problem."""
        import pydegensac

        def fundamental(p: EstimationProblem, limits: EstimationLimits) -> Model:
            return pydegensac.findFundamentalMatrix(
                p.first, p.second, limits.max_error_px, limits.confidence, limits.max_iterations, seed=0
            )[0]

        def homography(p: EstimationProblem, limits: EstimationLimits) -> Model:
            return pydegensac.findHomography(
                p.first, p.second, limits.max_error_px, limits.confidence, limits.max_iterations, seed=0
            )[0]

        return {"fundamental": fundamental, "homography": homography}


PEERS: tuple[EstimationPeer, ...] = (
    Epipole(),
    Fastpose(),
    Poselib(),
    OpenCv("USAC_MAGSAC"),
    OpenCv("USAC_ACCURATE"),
    Pycolmap(),
    Pydegensac(),
)


class Worker:
    """A process in which a peer solves one problem at a time."""

    def __init__(self, peer: EstimationPeer, kind: Kind) -> None:
        self.name = peer.name
        context = get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(peer, kind, theirs), daemon=True)
        self._process.start()

    def solve(self, problem: EstimationProblem, limits: EstimationLimits) -> tuple[float, Model]:
        """Median seconds of three calls (fewer if they are long), and the model of the last one."""
        self._connection.send((problem, limits))
        return self._connection.recv()

    def close(self) -> None:
        """End the process."""
        self._connection.send(None)
        self._process.join(10)


def _serve(peer: EstimationPeer, kind: Kind, connection: Connection) -> None:
    os.environ["EPIPOLE_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"
    estimate = peer.estimators()[kind]
    while (message := connection.recv()) is not None:
        seconds = []
        model: Model = None
        for _ in range(_REPEATS):
            start = time.perf_counter()
            try:
                model = estimate(*message)
            except Exception:  # noqa: BLE001 - any exception of a peer is a failure
                model = None
            seconds.append(time.perf_counter() - start)
            if sum(seconds) > _LONG_ENOUGH_S:
                break
        connection.send((statistics.median(seconds), model))
