"""Writing cameras and points as USD files (OpenUSD, Pixar) for Nuke, Houdini, Blender and other programs, with usd-core.

A UsdGeom.Camera looks along -z with y up. Its focal length and apertures are in tenths of a unit of the stage. Only their ratios
have an effect: a pixel is W / width wide, where W is the horizontal aperture of 36 mm. An aperture offset moves the frustum's
window to the right or up, so a principal point to the right of the image center is a negative horizontal offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import checked
from epipole.cameras import Camera
from epipole.errors import ShapeError
from epipole.geometry import Rigid3
from epipole.io.meshes._usd_stages import ROOT, check_suffix, new_stage, usd_modules, write_stage
from epipole.io.models._brown import refuse_distortion
from epipole.io.models.chan import frame_numbers
from epipole.scene import Points, Reconstruction
from epipole.scene.local_origin import local_origin

CAMERA, POINTS = f"{ROOT}/camera", f"{ROOT}/points"
"""Paths of the prims of an animated camera, or of all cameras, and of the points."""
IMAGE_NAME = "epipole:imageName"
"""Attribute of a camera: the name of its image, at each frame if it is animated."""

_APERTURE = 0.36
"""Width of the aperture in tenths of a meter: 36 mm."""
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_CLIPPING = 1e-3, 1e3
"""Distances of the clipping planes, relative to the median distance of the cameras from the points."""
_POINT_WIDTH = 2e-3
"""Diameter of the points, relative to the same distance."""
_LEAST_SCALE = 1e-30


@checked
def write_usd_cameras(
    path: str | Path,
    reconstruction: Reconstruction,
    *,
    up: Float64[np.ndarray, " 3"] | None = None,
    origin_in_world: Float64[np.ndarray, " 3"] | None = None,
) -> None:
    """Write the registered images as cameras, and the points.

    If all images are of one camera, it is the prim `/model/camera` with time samples at the frames of `frame_numbers`, which
    Nuke and Blender play as an animation. Otherwise there is a camera for each image below that prim. The attribute
    `epipole:imageName` has the names of the images. Origin, unit and rotation of the root prim are as in `write_usd`, so
    cameras and a mesh that are written with the same origin and up direction match. The position of a georeferenced model on
    Earth is in the layer's `customLayerData`, as `georeference` (the content of georeference.json).

    Args:
        path: the file, with the suffix `.usdz`, `.usdc` or `.usda`.
        reconstruction: the model.
        up: as in `write_usd`.
        origin_in_world: as in `write_usd`; None: `local_origin` of the points and cameras.

    Raises:
        ConfigError: the suffix is not valid, or a camera has distortion (undistort the images first).
        ShapeError: no image is registered, the up direction is zero or not finite, or coordinates relative to the origin
            exceed single precision.
        WorkspaceError: the file cannot be written.
        MissingDependencyError: usd-core is not installed.
    """
    path, model = Path(path), reconstruction
    check_suffix(path)
    numbers = frame_numbers(model.images.name)
    registered = np.flatnonzero(model.is_registered()).tolist()
    registered.sort(key=lambda image: numbers[image])
    if not registered:
        raise ShapeError("the model has no registered image")
    rows = [int(model.camera_of_image[image]) for image in registered]
    for row in sorted(set(rows)):
        refuse_distortion(model.cameras[row], "a camera of USD")
    pxr = usd_modules()
    centers, xyz = model.camera_centers_in_world()[registered], model.points.xyz_in_world
    origin = local_origin(np.concatenate([xyz, centers])) if origin_in_world is None else origin_in_world
    stage = new_stage(pxr, origin, up, model.georeference)
    scale = _scale_of(xyz, centers)
    worlds_from_cams = model.cams_from_world()[registered].inverse()
    matrices = _matrices(Rigid3(worlds_from_cams.rotation, worlds_from_cams.translation - origin))
    names = [model.images.name[image] for image in registered]
    if len(set(rows)) == 1:
        frames = [numbers[image] for image in registered]
        prim = _add_camera(pxr, stage, CAMERA, model.cameras[rows[0]], scale)
        _animate(pxr, stage, prim, frames, matrices, names)
    else:
        pxr.UsdGeom.Scope.Define(stage, CAMERA)
        for k, (row, matrix, name) in enumerate(zip(rows, matrices, names)):
            prim = _add_camera(pxr, stage, f"{CAMERA}/image_{k:06d}", model.cameras[row], scale)
            prim.AddTransformOp().Set(pxr.Gf.Matrix4d(matrix.tolist()))
            _image_name(pxr, prim).Set(name)
            prim.GetPrim().SetDisplayName(name)
    _add_points(pxr, stage, model.points, origin, _POINT_WIDTH * scale)
    write_stage(path, stage, {})


def _scale_of(xyz: np.ndarray, centers: np.ndarray) -> float:
    """The median distance of the cameras from the middle of the points, or of the cameras."""
    points = xyz[np.isfinite(xyz).all(axis=1)]
    middle = np.median(points if len(points) else centers, axis=0)
    scale = float(np.median(np.linalg.norm(centers - middle, axis=1)))
    return scale if scale > _LEAST_SCALE else 1.0


def _matrices(worlds_from_cams: Rigid3) -> np.ndarray:
    """(n, 4, 4) transforms for row vectors, of cameras that look along -z."""
    return np.swapaxes(worlds_from_cams.as_matrix() @ _FLIP, 1, 2)


def _add_camera(pxr: Any, stage: Any, prim_path: str, camera: Camera, scale: float) -> Any:
    """Add a camera without a pose."""
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    focal = _APERTURE * fx / camera.width
    values = {
        "FocalLength": focal,
        "HorizontalAperture": _APERTURE,
        "VerticalAperture": camera.height * focal / fy,
        "HorizontalApertureOffset": focal * (0.5 * (camera.width - 1) - cx) / fx,
        "VerticalApertureOffset": focal * (cy - 0.5 * (camera.height - 1)) / fy,
    }
    prim = pxr.UsdGeom.Camera.Define(stage, prim_path)
    for key, value in values.items():
        getattr(prim, f"Create{key}Attr")(float(value))
    near, far = (factor * scale for factor in _CLIPPING)
    prim.CreateClippingRangeAttr(pxr.Gf.Vec2f(near, far))
    return prim


def _animate(
    pxr: Any, stage: Any, prim: Any, frames: Sequence[int], matrices: np.ndarray, names: Sequence[str]
) -> None:
    """Set the pose of a camera and the name of its image at each frame."""
    stage.SetStartTimeCode(frames[0])
    stage.SetEndTimeCode(frames[-1])
    op, attribute = prim.AddTransformOp(), _image_name(pxr, prim)
    for frame, matrix, name in zip(frames, matrices, names):
        op.Set(pxr.Gf.Matrix4d(matrix.tolist()), float(frame))
        attribute.Set(name, float(frame))


def _image_name(pxr: Any, prim: Any) -> Any:
    return prim.GetPrim().CreateAttribute(IMAGE_NAME, pxr.Sdf.ValueTypeNames.String, True)


def _add_points(pxr: Any, stage: Any, points: Points, origin: np.ndarray, width: float) -> None:
    with np.errstate(over="ignore", invalid="ignore"):
        xyz = (points.xyz_in_world - origin).astype(np.float32)
    if not np.isfinite(xyz).all():
        raise ShapeError("the coordinates relative to the origin are too large for single precision")
    if not len(xyz):
        return
    vt = pxr.Vt
    out = pxr.UsdGeom.Points.Define(stage, POINTS)
    out.CreatePointsAttr(vt.Vec3fArray.FromNumpy(xyz))
    out.CreateWidthsAttr(vt.FloatArray([width]))
    out.SetWidthsInterpolation(pxr.UsdGeom.Tokens.constant)
    out.CreateExtentAttr(
        vt.Vec3fArray.FromNumpy(np.stack([xyz.min(axis=0) - width, xyz.max(axis=0) + width]))
    )
    colors = out.CreateDisplayColorPrimvar(pxr.UsdGeom.Tokens.vertex)
    colors.Set(vt.Vec3fArray.FromNumpy(_linear(points.rgb)))


def _linear(rgb: np.ndarray) -> np.ndarray:
    """Linear colors of sRGB values (IEC 61966-2-1); displayColor is linear."""
    value = rgb.astype(np.float64) / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return linear.astype(np.float32)
