"""Small trainers of every kind, before their first step."""

from functools import cache

from fields_scenes import WHITE, views

from epipole.fields.config import SplatTraining
from epipole.fields.nerf.hash_trainer import HashTrainer
from epipole.fields.nerf.voxel_trainer import VoxelTrainer
from epipole.fields.splat.starting import cloud_of_points, points_in_silhouettes
from epipole.fields.splat.trainer import SplatTrainer


@cache
def trainer_of(kind: str) -> SplatTrainer | HashTrainer | VoxelTrainer:
    """Of four views."""
    few = views()[:4]
    if kind == "splat":
        start = cloud_of_points(*points_in_silhouettes(few, 60, seed=1))
        options = SplatTraining(max_gaussians=80, exposure=True, refine_poses=True, sh_degree=1)
        return SplatTrainer(few, start, options, WHITE)
    return (HashTrainer if kind == "hash" else VoxelTrainer)(few, WHITE)
