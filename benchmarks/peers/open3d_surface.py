"""Open3D's TSDF or Poisson surface of arrays on disk, in its own process: `python open3d_surface.py METHOD INPUT.npz OUTPUT.npz`."""

import sys
import time

import numpy as np
import open3d as o3d

BAND_VOXELS, POISSON_DEPTH, LEAST_DENSITY = 4.0, 10, 0.05
"""Truncation in voxels, as in epipole; depth of the octree; quantile of the density below which Poisson's surface is removed."""


def tsdf(data: dict[str, np.ndarray]) -> o3d.geometry.TriangleMesh:
    """Scalable TSDF volume (Zhou and Koltun 2013) of all depth images."""
    voxel, (_, height, width) = float(data["voxel"]), data["depth"].shape
    K = data["K"]
    volume = o3d.pipelines.integration.ScalableTSDFVolume(
        voxel, BAND_VOXELS * voxel, o3d.pipelines.integration.TSDFVolumeColorType.NoColor
    )
    camera = o3d.camera.PinholeCameraIntrinsic(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    gray = o3d.geometry.Image(np.zeros((height, width, 3), np.uint8))
    for depth, pose in zip(data["depth"], data["poses"]):
        image = o3d.geometry.Image(np.ascontiguousarray(depth, np.float32))
        pair = o3d.geometry.RGBDImage.create_from_color_and_depth(
            gray, image, depth_scale=1.0, depth_trunc=float(depth.max()) + 1.0, convert_rgb_to_intensity=False
        )
        volume.integrate(pair, camera, np.vstack([pose, [0, 0, 0, 1]]) if pose.shape == (3, 4) else pose)
    return volume.extract_triangle_mesh()


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
