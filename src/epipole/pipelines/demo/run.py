"""The demo: reconstruct rendered photographs of a synthetic courtyard and compare with the exact truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole._checks import as_path, checked
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.io.images.photographs import write_jpeg_with_exif
from epipole.io.models.losses import losses_of
from epipole.metrics import CameraErrors, camera_errors
from epipole.pipelines.sfm.run import ReconstructionResult, reconstruct
from epipole.runs import Job, Progress, ProgressCallback, ignore_progress, open_run
from epipole.synthetic import courtyard, courtyard_views, render

WIDTH, HEIGHT, FOCAL_35MM = 960, 640, 28.0
NOISE_SIGMA = 2.0
MAX_RELATIVE_ERROR = 1e-3
"""Largest mean position error relative to the scene size; the demo fails beyond it."""


def demo_camera() -> Camera:
    """The camera of the demo: 28 mm (35 mm equivalent) with slight barrel distortion."""
    focal_px = FOCAL_35MM / 36.0 * WIDTH
    return Camera(
        CameraModel.SIMPLE_RADIAL,
        WIDTH,
        HEIGHT,
        np.array([focal_px, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, -0.05]),
    )


def render_photographs(folder: Path, num_views: int, progress: ProgressCallback) -> Rigid3:
    """Write JPEGs with EXIF; returns the true cam_from_world of the views."""
    scene, views, camera = courtyard(), courtyard_views(num_views), demo_camera()
    for n in range(num_views):
        image = render(scene, camera, views[n], noise_sigma=NOISE_SIGMA, seed=n)
        write_jpeg_with_exif(folder / photograph_name(n), image.rgb, focal_35mm=FOCAL_35MM)
        progress(Progress("render", n + 1, num_views))
    return views


def photograph_name(n: int) -> str:
    """File name of the n-th view."""
    return f"courtyard_{n + 1:03d}.jpg"


@dataclass(frozen=True, slots=True, eq=False)
class DemoResult:
    """The reconstruction of the demo and its errors."""

    reconstruction: ReconstructionResult
    num_views: int
    num_registered: int
    errors: CameraErrors
    size_m: float
    """Diagonal of the bounding box of the camera centers."""

    @property
    def relative_error(self) -> float:
        """Mean position error over `size_m`."""
        return self.errors.mean_position / self.size_m

    @property
    def success(self) -> bool:
        """Whether all images are registered and accurate enough."""
        return self.num_registered == self.num_views and self.relative_error <= MAX_RELATIVE_ERROR

    def __repr__(self) -> str:
        return (
            f"DemoResult({self.num_registered} of {self.num_views} images registered, position error "
            f"{100 * self.relative_error:.3g} % of the scene)"
        )


@checked
def demo(
    out: str | Path = "demo", num_views: int = 24, progress: ProgressCallback = ignore_progress
) -> DemoResult:
    """Render photographs of a synthetic courtyard, reconstruct them, and compare with the exact truth.

    Raises:
        WorkspaceError: the folder contains something other than a demo.
        ConfigError: num_views is less than 2.
    """
    if num_views < 2:
        raise ConfigError(f"num_views must be at least 2, got {num_views}")
    job = Job(kind="demo", inputs=(), settings={"views": num_views}, progress=progress)
    with open_run(job, as_path(out)) as run:
        photographs, model = run.root / "photographs", run.root / "model"
        with run.stage("render"), run.folder.publish("photographs") as aside:
            truth = render_photographs(aside / "photographs", num_views, progress)
        result = reconstruct(photographs, model, progress=progress)
        found = _compare(result, truth)
        run.finish(
            {
                "num_views": num_views,
                "num_registered": found.num_registered,
                "relative_error": found.relative_error,
                "warnings": losses_of(result.summary, model),
            }
        )
        return found


def _compare(result: ReconstructionResult, truth: Rigid3) -> DemoResult:
    model = result.model
    rows = {name: i for i, name in enumerate(model.images.name)}
    registered = model.is_registered()
    names = [photograph_name(n) for n in range(len(truth))]
    found = [n for n, name in enumerate(names) if name in rows and registered[rows[name]]]
    estimated = model.cams_from_world()[[rows[names[n]] for n in found]]
    size = float(np.linalg.norm(np.ptp(truth.centers(), axis=0)))
    return DemoResult(result, len(truth), len(found), camera_errors(estimated, truth[found]), size)
