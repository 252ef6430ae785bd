"""Open3D's TSDF or Poisson surface of arrays on disk, in its own process: `python open3d_surface.py METHOD INPUT.npz OUTPUT.npz`."""

import sys
import time

import numpy as np
import open3d as o3d

BAND_VOXELS, LEAST_WEIGHT = 4.0, 0.5
"""Truncation in voxels, and number of depths that a voxel needs, as in epipole."""
POISSON_DEPTH, LEAST_DENSITY = 10, 0.05
"""Depth of the octree, and quantile of the density below which Poisson's surface is removed."""


def tsdf(data: dict[str, np.ndarray]) -> o3d.geometry.TriangleMesh:
    """Truncated signed distances in blocks of voxels (Dong et al. 2021) from all depth images."""
    most = float(data["depth"].max()) + 1.0
    volume = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight"),
        attr_dtypes=(o3d.core.float32, o3d.core.float32),
        attr_channels=((1), (1)),
        voxel_size=float(data["voxel"]),
        block_resolution=8,
        block_count=200_000,
    )
    K = o3d.core.Tensor(data["K"])
    for depth, pose in zip(data["depth"], data["poses"]):
        image, motion = o3d.t.geometry.Image(o3d.core.Tensor(depth)), o3d.core.Tensor(pose)
        blocks = volume.compute_unique_block_coordinates(image, K, motion, 1.0, most, BAND_VOXELS)
        volume.integrate(blocks, image, K, motion, 1.0, most, BAND_VOXELS)
    return volume.extract_triangle_mesh(weight_threshold=LEAST_WEIGHT).to_legacy()


def poisson(data: dict[str, np.ndarray]) -> o3d.geometry.TriangleMesh:
    """Screened Poisson surface (Kazhdan and Hoppe 2013) of the points with normals."""
    known = np.linalg.norm(data["normals"], axis=1) > 0.5
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(data["xyz"][known]))
    cloud.normals = o3d.utility.Vector3dVector(data["normals"][known])
    mesh, density = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=POISSON_DEPTH, n_threads=2
    )
    density = np.asarray(density)
    mesh.remove_vertices_by_mask(density < np.quantile(density, LEAST_DENSITY))
    return mesh


def main() -> None:
    """Run the method, and write vertices, faces and seconds."""
    method, source, target = sys.argv[1:]
    with np.load(source) as stored:
        data = {name: stored[name] for name in stored.files}
    start = time.perf_counter()
    mesh = {"tsdf": tsdf, "poisson": poisson}[method](data)
    seconds = time.perf_counter() - start
    np.savez(target, vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.triangles), seconds=seconds)


if __name__ == "__main__":
    main()
