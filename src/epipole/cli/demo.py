"""The demo: photographs of a made-up courtyard, treated as any user's folder, compared with the exact truth."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from epipole.api import ReconstructionResult, reconstruct
from epipole.cameras import Camera, CameraModel
from epipole.cli.screen import progress_on_screen, show_reconstruction
from epipole.errors import WorkspaceError
from epipole.geometry import Rigid3
from epipole.io.photographs import write_jpeg_with_exif
from epipole.metrics import camera_errors
from epipole.sfm.workspace import write_json
from epipole.synthetic import courtyard, courtyard_views, render
from epipole.workflow import Progress, ProgressCallback

WIDTH, HEIGHT, FOCAL_35MM = 960, 640, 28.0
NOISE_SIGMA = 2.0
DEMO_MARK = "epipole-demo.json"
MAX_RELATIVE_ERROR = 1e-3


def demo_camera() -> Camera:
    """The camera of the demo: a 28 mm lens with a little barrel distortion."""
    focal_px = FOCAL_35MM / 36.0 * WIDTH
    return Camera(
        CameraModel.SIMPLE_RADIAL,
        WIDTH,
        HEIGHT,
        np.array([focal_px, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, -0.05]),
    )


def render_photographs(folder: Path, num_views: int, progress: ProgressCallback) -> Rigid3:
    """Write JPEGs with EXIF; returns the true cams_from_world."""
    scene, views, camera = courtyard(), courtyard_views(num_views), demo_camera()
    for n in range(num_views):
        picture = render(scene, camera, views[n], noise_sigma=NOISE_SIGMA, seed=n)
        write_jpeg_with_exif(folder / photograph_name(n), picture.rgb, focal_35mm=FOCAL_35MM)
        progress(Progress("render", n + 1, num_views))
    return views


def photograph_name(n: int) -> str:
    """File name of the n-th view."""
    return f"courtyard_{n + 1:03d}.jpg"


def run_demo(out: Path, num_views: int) -> None:
    """Render, reconstruct, compare, print.

    Raises:
        WorkspaceError: the folder holds something that is no demo, or the result misses the truth.
    """
    photographs, model, mark = out / "photographs", out / "model", out / DEMO_MARK
    if out.exists() and not mark.is_file() and (not out.is_dir() or any(out.iterdir())):
        raise WorkspaceError(f"{out} is not empty and holds no demo; choose another folder")
    for ours in (photographs, model):
        shutil.rmtree(ours, ignore_errors=True)
    photographs.mkdir(parents=True)
    write_json(mark, {"views": num_views})
    with progress_on_screen(compiles_much=True) as progress:
        truth = render_photographs(photographs, num_views, progress)
        result = reconstruct(photographs, model, progress=progress)
    show_reconstruction(result)
    relative, placed = _compare(result, truth)
    if placed < num_views or relative > MAX_RELATIVE_ERROR:
        raise WorkspaceError(
            f"the demo missed its truth: {placed} of {num_views} placed, position error {100 * relative:.3f} % of the scene"
        )


def _compare(result: ReconstructionResult, truth: Rigid3) -> tuple[float, int]:
    model = result.model
    rows = {name: i for i, name in enumerate(model.images.name)}
    found = [
        n
        for n in range(len(truth))
        if photograph_name(n) in rows and model.is_registered()[rows[photograph_name(n)]]
    ]
    estimated = model.cams_from_world()[[rows[photograph_name(n)] for n in found]]
    errors = camera_errors(estimated, truth[found])
    centers = truth.centers()
    size = float(np.linalg.norm(np.ptp(centers, axis=0)))
    relative = errors.mean_position / size
    table = Table(title="Against the exact truth", box=None, show_header=False)
    table.add_row("images placed", f"{len(found)} of {len(truth)}")
    table.add_row(
        "position error",
        f"mean {1000 * errors.mean_position:.2f} mm = {100 * relative:.4f} % of the scene ({size:.1f} m)",
    )
    table.add_row("rotation error", f"mean {errors.mean_rotation_deg:.4f} degrees")
    Console().print(table)
    return relative, len(found)
