"""Whatever a path holds, as an object."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from epipole._checks import as_path, checked
from epipole.errors import FileFormatError
from epipole.io.calibration.files import read_calibration
from epipole.io.contents_in_words import results_of, with_what_it_is
from epipole.io.convert import is_model_file, read_model
from epipole.io.files import missing_in_words
from epipole.io.images.depth_maps import read_pfm, read_png16
from epipole.io.meshes.gltf import read_glb
from epipole.io.meshes.mesh_ply import read_mesh_ply
from epipole.io.trajectories.files import read_trajectory
from epipole.pipelines.calibration import scene as calibration
from epipole.pipelines.calibration.scene import CALIBRATION
from epipole.pipelines.fields import scene as fields
from epipole.pipelines.fields.kinds import kind_in
from epipole.pipelines.fields.scene import seen_gaussians
from epipole.pipelines.slam.output import scene as slam
from epipole.pipelines.slam.output.map_file import load_slam_map
from epipole.pipelines.stereo import scene as stereo
from epipole.pipelines.stereo.files import read_stereo
from epipole.pipelines.surfaces import scene as surfaces
from epipole.pipelines.viewing import files

READABLE = (
    "pass an output folder, a COLMAP model, a transforms.json, cameras of OpenSfM, Metashape, RealityScan, Bundler or Nuke, a SLAM map, "
    "Gaussians, a trajectory, a calibration, a PLY or GLB file, or a depth map (PFM, 16-bit PNG)"
)
WITH_MODEL = ("reconstruct", "slam", "demo")
"""Commands whose output folders have a model; if it is missing, the error names its files."""


@checked
def load(path: str | Path) -> Any:
    """Read what a path holds; its content decides, not its name.

    | path | result |
    |---|---|
    | output folder of `reconstruct` or `slam`, COLMAP model, transforms.json | Reconstruction |
    | cameras of OpenSfM (.json), Metashape (.xml), RealityScan (.csv), Bundler (.out), Nuke (.chan), kapture | Reconstruction |
    | output folder of `splat`, file of Gaussians (PLY, SPZ, SOG, .splat) | GaussianCloud |
    | output folder of `nerf` | Voxels or HashField |
    | output folder of `stereo` | StereoFiles: disparities, reasons, depths, rig |
    | map of SLAM (`OUT/map`, .npz) | SlamMap |
    | trajectory (TUM, KITTI, EuRoC) | Trajectory |
    | calibration | CalibrationFile |
    | output folder of `surface` | TexturedMesh; PlyMesh if it has no texture, with points only if it has no mesh |
    | PLY file of points or triangles | PlyMesh |
    | textured mesh (GLB) | TexturedMesh |
    | depth map (PFM, 16-bit PNG) | (h, w) array |

    Args:
        path: file or folder.

    Raises:
        FileFormatError: there is nothing, or nothing that can be read.
    """
    path = as_path(path)
    if not path.exists():
        raise FileFormatError(path, missing_in_words(path))
    if fields.is_mine(path):
        found = kind_in(path)
        return seen_gaussians(path)[0] if found is None else found[0].read(found[1])
    if files.is_ply(path):
        return read_mesh_ply(path)
    if files.is_glb(path):
        return read_glb(path)
    if surfaces.is_mine(path):
        return surfaces.read(path)
    if stereo.is_mine(path) or stereo.is_pair_file(path):
        return read_stereo(path if path.is_dir() else path.parent)
    if files.is_depth_map(path):
        return read_pfm(path) if path.suffix.lower() == ".pfm" else read_png16(path)
    if slam.is_mine(path):
        return read_model(path / "sparse" / "0")
    if slam.is_map(path):
        return load_slam_map(path)
    if slam.is_trajectory(path):
        return read_trajectory(path)
    if calibration.is_mine(path):
        return read_calibration(path / CALIBRATION if path.is_dir() else path)
    if path.is_file() and not is_model_file(path):
        raise FileFormatError(
            path, with_what_it_is("epipole.load cannot read this kind of file", path, READABLE)
        )
    try:
        return read_model(path)
    except FileFormatError as error:
        if path.is_file() or results_of(path) in WITH_MODEL:
            raise
        raise FileFormatError(
            path, with_what_it_is("nothing in this folder can be read", path, READABLE)
        ) from error
