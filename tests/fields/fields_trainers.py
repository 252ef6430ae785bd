"""Small trainers of every kind, before their first step."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import pytest
from fields_scenes import WHITE, views

from epipole.fields.config import SplatTraining
from epipole.fields.nerf import hash_trainer, voxel_trainer
from epipole.fields.nerf.hash_trainer import HashTrainer
from epipole.fields.nerf.voxel_trainer import VoxelTrainer
from epipole.fields.splat.starting import cloud_of_points, points_in_silhouettes
from epipole.fields.splat.trainer import SplatTrainer

SMALL_HASH = {"SIDE": 64, "ROWS": 1 << 13, "SAMPLES": 1024, "WARM_UP": 64, "NUM_PARTS": 4}
"""Fewer cells, rows of tables and samples, and empty cells are marked after 64 steps."""


@contextmanager
def small_neural_fields() -> Iterator[None]:
    """Neural fields cost a sixth."""
    with pytest.MonkeyPatch.context() as patched:
        for name, value in SMALL_HASH.items():
            patched.setattr(hash_trainer, name, value)
        yield


@cache
def trainer_of(kind: str) -> SplatTrainer | HashTrainer | VoxelTrainer:
    """Of four views."""
    few = views()[:4]
    if kind == "splat":
        start = cloud_of_points(*points_in_silhouettes(few, 60, seed=1))
        options = SplatTraining(max_gaussians=80, exposure=True, refine_poses=True, sh_degree=1)
        return SplatTrainer(few, start, options, WHITE)
    with small_neural_fields(), pytest.MonkeyPatch.context() as patched:
        patched.setattr(voxel_trainer, "SIZES", ((0.0, 16), (0.08, 32), (0.30, 64)))
        return (HashTrainer if kind == "hash" else VoxelTrainer)(few, WHITE)
