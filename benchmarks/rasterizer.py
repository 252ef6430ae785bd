"""Speed of the rasterizer in Gaussian-pixel pairs and frames per second. `python -m benchmarks.rasterizer`."""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import epipole
from benchmarks.measure import REPOSITORY, describe_machine
from epipole.fields.splat.numba_backend import blend, gradient_of, sums_of_pairs, tiles_of
from epipole.fields.splat.rasterizer import (
    ImageGradient,
    RenderOptions,
    arrays_of,
    view_of,
)
from epipole.io.gaussians.files import read_gaussians
from epipole.pipelines.fields.cameras import RenderView, orbit
from epipole.pipelines.fields.config import FieldOptions, RenderConfig
from epipole.pipelines.fields.images import gather_field_images
from epipole.pipelines.fields.scene import seen_gaussians
from epipole.scene.gaussian_cloud import GaussianCloud

RESULTS = REPOSITORY / "benchmarks" / "results" / "rasterizer.json"
FLOPS = (32, 58)
"""Operations per pair, forward and backward, counted in `epipole.fields.splat._simd_kernels`: a fused multiply-add is two, exp is 12."""
SCENE_STEPS = 600
"""Training steps, after which lego has its final number of Gaussians."""


def multiplied(cloud: GaussianCloud, count: int) -> GaussianCloud:
    """A cloud of `count` Gaussians: jittered copies, reduced in size so that the coverage stays the same."""
    rng = np.random.default_rng(0)
    rows = np.concatenate([np.arange(len(cloud)), rng.integers(0, len(cloud), max(0, count - len(cloud)))])
    rows = rows[:count]
    shrink = np.float32(0.5 * np.log(len(cloud) / count)) if count > len(cloud) else np.float32(0.0)
    picked = cloud.rows(rows)
    moved = picked.means_in_world + rng.normal(size=(count, 3)).astype(np.float32) * np.exp(
        picked.log_scales
    ) * np.float32(0.5 if count > len(cloud) else 0.0)
    return GaussianCloud(
        moved, picked.log_scales + shrink, picked.quats_wxyz, picked.opacity_logits, picked.sh
    )


def views_around(source: Path, size: tuple[int, int], rounds: int) -> list[RenderView]:
    """Views on a circle around a model."""
    _, known = seen_gaussians(source)
    job = RenderConfig(frames=rounds, width=size[0], height=size[1])
    return orbit(known.position, known.look_at, known.up, job)


def held_out_views(source: Path, side: int, rounds: int) -> list[RenderView]:
    """Test views of a data set, scaled to `side` x `side` pixels."""
    views, shots = gather_field_images(source, FieldOptions()).test, []
    for k in range(rounds):
        view = views[k % len(views)]
        shots.append(RenderView(view.name, view.camera.scaled_to(side, side), view.cam_from_world))
    return shots


def measured(cloud: GaussianCloud, shots: list[RenderView]) -> dict[str, Any]:
    """Median times and rates over the views, without the first one."""
    arrays, rows = arrays_of(cloud), []
    for shot in shots:
        view = view_of(shot.camera, shot.cam_from_world, RenderOptions())
        start = perf_counter()
        tiles = tiles_of(arrays, view)
        tiled = perf_counter()
        rendered = blend(tiles, view)
        blended = perf_counter()
        by_pair = sums_of_pairs(rendered, ImageGradient(rendered.color))
        summed = perf_counter()
        gradient_of(arrays, view, rendered.record, by_pair)
        end = perf_counter()
        pairs = rendered.num_evaluated
        rows.append((pairs, tiled - start, blended - tiled, summed - blended, end - summed))
    pairs, prepare, forward, backward, gather = (float(median(column)) for column in zip(*rows[1:]))
    return {
        "gaussians": len(cloud),
        "size": [shots[0].camera.width, shots[0].camera.height],
        "pairs": pairs,
        "prepare_s": prepare,
        "forward_s": forward,
        "backward_s": backward,
        "gather_s": gather,
        "forward_pairs_s": pairs / forward,
        "backward_over_forward": backward / forward,
        "whole_backward_over_forward": (backward + gather) / (prepare + forward),
        "gflops": [FLOPS[0] * pairs / forward / 1e9, FLOPS[1] * pairs / backward / 1e9],
        "frames_s": 1.0 / (prepare + forward),
    }


def main() -> None:
    """Measure, print the table and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=24)
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    arguments = parser.parse_args()
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    source = data / "fields" / "splats" / "guitar.compressed.ply"
    guitar = read_gaussians(source)
    rounds, lego = arguments.rounds + 1, data / "fields" / "lego"
    with tempfile.TemporaryDirectory(prefix="epipole-rasterizer-") as folder:
        scene = epipole.splat(lego, Path(folder), steps=SCENE_STEPS, max_gaussians=500_000).cloud
    rows = {
        "guitar, 640 x 480": measured(guitar, views_around(source, (640, 480), rounds)),
        "guitar, 800 x 800": measured(guitar, views_around(source, (800, 800), rounds)),
        "guitar multiplied, 800 x 800": measured(
            multiplied(guitar, 500_000), views_around(source, (800, 800), rounds)
        ),
        "lego, 800 x 800": measured(scene, held_out_views(lego, 800, rounds)),
    }
    RESULTS.write_text(json.dumps({"machine": describe_machine(2), "rows": rows}, indent=1) + "\n")
    table = Table(
        "scene", "Gaussians", "M pairs", "forward G pairs/s", "backward / forward", "GFLOP/s", "frames/s"
    )
    for name, row in rows.items():
        table.add_row(
            name,
            f"{row['gaussians']:,}",
            f"{row['pairs'] / 1e6:.1f}",
            f"{row['forward_pairs_s'] / 1e9:.2f}",
            f"{row['backward_over_forward']:.2f} ({row['whole_backward_over_forward']:.2f} with all stages)",
            f"{row['gflops'][0]:.0f}, {row['gflops'][1]:.0f}",
            f"{row['frames_s']:.1f}",
        )
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
