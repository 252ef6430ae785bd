"""Cameras and points as USD files, read back by OpenUSD: its own frustum projects points to the pixels of the model."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, MissingDependencyError, ShapeError
from epipole.geometry import Rigid3
from epipole.io.georeference import georeference_of_fields
from epipole.io.meshes.usd_cameras import write_usd_cameras
from epipole.scene import Cameras, Georeference, Reconstruction
from io_models import mappable_model, small_model

UP = np.array([0.3, -1.0, 0.2])


def undistorted(model: Reconstruction) -> Reconstruction:
    """Pinhole cameras with two focal lengths, and principal points that are not the image centers."""
    cameras = []
    for camera in model.cameras:
        K = camera.K
        params = np.array([K[0, 0], 1.1 * K[1, 1], K[0, 2] + 31.0, K[1, 2] - 17.0])
        cameras.append(Camera(CameraModel.PINHOLE, camera.width, camera.height, params))
    return replace(model, cameras=Cameras.from_list(cameras))


def opened(path: Path) -> Usd.Stage:
    return Usd.Stage.Open(str(path))


def origin_of(stage: Usd.Stage) -> np.ndarray:
    return np.array(stage.GetRootLayer().customLayerData.get("origin_in_world", (0, 0, 0)))


def pixels_of(
    prim: UsdGeom.Camera, time: Usd.TimeCode, camera: Camera, xyz_in_stage: np.ndarray
) -> np.ndarray:
    """(n, 2) by the view and the frustum of OpenUSD, for an image whose corners are those of the window."""
    gf_camera = prim.GetCamera(time)
    frustum = gf_camera.frustum
    view = np.array(frustum.ComputeViewMatrix()) @ np.array(frustum.ComputeProjectionMatrix())
    clip = np.column_stack([xyz_in_stage, np.ones(len(xyz_in_stage))]) @ view
    x, y = (clip[:, :2] / clip[:, 3:]).T
    return np.stack([0.5 * camera.width * (1 + x) - 0.5, 0.5 * camera.height * (1 - y) - 0.5], axis=1)


def in_stage(stage: Usd.Stage, xyz_in_world: np.ndarray) -> np.ndarray:
    """By the transform of the root prim."""
    root = UsdGeom.Xformable(stage.GetDefaultPrim()).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    moved = np.column_stack([xyz_in_world - origin_of(stage), np.ones(len(xyz_in_world))])
    return (moved @ np.array(root))[:, :3]


@pytest.mark.parametrize("suffix", ["usda", "usdc", "usdz"])
def test_frames_of_one_camera_are_an_animation(tmp_path: Path, suffix: str) -> None:
    model = undistorted(mappable_model())
    names = tuple(f"plate.{1001 + 2 * n}.jpg" for n in range(len(model.images)))
    model = replace(model, images=replace(model.images, name=names))
    write_usd_cameras(tmp_path / f"a.{suffix}", model, up=UP)
    stage = opened(tmp_path / f"a.{suffix}")
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (1001, 1001 + 2 * (len(names) - 1))
    prim = UsdGeom.Camera(stage.GetPrimAtPath("/model/camera"))
    assert prim.GetPrim().GetAttribute("xformOp:transform").GetTimeSamples() == [
        float(1001 + 2 * n) for n in range(len(names))
    ]
    xyz = in_stage(stage, model.points.xyz_in_world)
    for image, name in enumerate(names):
        time = Usd.TimeCode(1001 + 2 * image)
        assert prim.GetPrim().GetAttribute("epipole:imageName").Get(time) == name
        expected = model.cameras[0].project(model.cams_from_world()[image].apply(model.points.xyz_in_world))
        found = pixels_of(prim, time, model.cameras[0], xyz)
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-4)  # apertures are in single precision
    up_in_stage = in_stage(stage, UP[None] / np.linalg.norm(UP))[0] - in_stage(stage, np.zeros((1, 3)))[0]
    np.testing.assert_allclose(up_in_stage, [0, 1, 0], atol=1e-12)
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0


def test_photographs_of_different_cameras_are_static_cameras(tmp_path: Path) -> None:
    model = undistorted(small_model())
    write_usd_cameras(tmp_path / "a.usda", model)
    stage = opened(tmp_path / "a.usda")
    prims = {
        prim.GetAttribute("epipole:imageName").Get(): UsdGeom.Camera(prim)
        for prim in stage.Traverse()
        if prim.IsA(UsdGeom.Camera)
    }
    registered = np.flatnonzero(model.is_registered())
    assert set(prims) == {model.images.name[image] for image in registered} and len(prims) == 8
    for image in registered:
        camera = model.cameras[int(model.camera_of_image[image])]
        expected = camera.project(model.cams_from_world()[image].apply(model.points.xyz_in_world))
        prim = prims[model.images.name[image]]
        assert not prim.GetPrim().GetAttribute("xformOp:transform").GetTimeSamples()
        found = pixels_of(prim, Usd.TimeCode.Default(), camera, in_stage(stage, model.points.xyz_in_world))
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-4)


def test_units_and_offsets(tmp_path: Path) -> None:
    """Tenths of a unit of one meter: 0.36 of them are 36 mm."""
    model = mappable_model()
    camera = Camera(CameraModel.PINHOLE, 640, 480, np.array([500.0, 400.0, 319.5 + 32.0, 239.5 + 24.0]))
    write_usd_cameras(tmp_path / "a.usda", replace(model, cameras=Cameras.from_list([camera])))
    stage = opened(tmp_path / "a.usda")
    found = UsdGeom.Camera(stage.GetPrimAtPath("/model/camera"))
    values = {
        "HorizontalAperture": 0.36,
        "FocalLength": 0.36 * 500 / 640,
        "VerticalAperture": 0.36 * 480 / 640 * 500 / 400,
        "HorizontalApertureOffset": -0.36
        * 32
        / 640,  # the window moves left: the principal point is right of its center
        "VerticalApertureOffset": 0.36 * 24 / 640 * 500 / 400,
    }
    for key, value in values.items():
        assert getattr(found, f"Get{key}Attr")().Get() == pytest.approx(value, rel=1e-6), key


def test_points_and_colors(tmp_path: Path) -> None:
    """Colors are linear: those of IEC 61966-2-1 for 0, 10, 188 and 255."""
    model = small_model()
    rgb = model.points.rgb.copy()
    rgb[:2] = [[0, 10, 255], [188, 0, 0]]
    model = replace(model, points=replace(model.points, rgb=rgb))
    write_usd_cameras(tmp_path / "a.usdc", undistorted(model))
    stage = opened(tmp_path / "a.usdc")
    points = UsdGeom.Points(stage.GetPrimAtPath("/model/points"))
    np.testing.assert_allclose(points.GetPointsAttr().Get(), model.points.xyz_in_world, atol=1e-6)
    colors = points.GetDisplayColorPrimvar().Get()
    assert points.GetDisplayColorPrimvar().GetInterpolation() == "vertex"
    np.testing.assert_allclose(colors[0], [0.0, 0.0030353, 1.0], rtol=1e-4)
    assert colors[1][0] == pytest.approx(0.5028865, rel=1e-5)
    assert points.GetWidthsInterpolation() == "constant" and len(points.GetWidthsAttr().Get()) == 1


def test_the_position_on_earth_is_in_the_layer(tmp_path: Path) -> None:
    origin = Georeference(46.5, 7.25, 500.0, "EPSG:32632")
    write_usd_cameras(tmp_path / "a.usda", replace(undistorted(small_model()), georeference=origin))
    stage = opened(tmp_path / "a.usda")
    content = stage.GetRootLayer().customLayerData["georeference"]
    assert georeference_of_fields("a.usda", dict(content)) == origin


def test_far_coordinates_keep_their_precision(tmp_path: Path) -> None:
    model, far = undistorted(mappable_model()), np.array([691_000.0, 5_335_000.0, 500.0])
    moved = replace(
        model,
        points=replace(model.points, xyz_in_world=model.points.xyz_in_world + far),
        frames=replace(
            model.frames,
            rig_from_world=Rigid3(
                model.cams_from_world().rotation,
                model.cams_from_world().translation - model.cams_from_world().rotation @ far,
            ),
        ),
    )
    write_usd_cameras(tmp_path / "a.usda", moved)
    stage = opened(tmp_path / "a.usda")
    assert np.abs(origin_of(stage) - far).max() < 10
    prim = UsdGeom.Camera(stage.GetPrimAtPath("/model/camera"))
    expected = model.cameras[0].project(model.cams_from_world()[0].apply(model.points.xyz_in_world))
    xyz = np.array(UsdGeom.Points(stage.GetPrimAtPath("/model/points")).GetPointsAttr().Get(), np.float64)
    found = pixels_of(prim, Usd.TimeCode(0), model.cameras[0], xyz)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3)


def test_the_validators_of_openusd_find_nothing(tmp_path: Path) -> None:
    validation = pytest.importorskip("pxr.UsdValidation", reason="needs usd-core>=25")
    for name, model in (("one", mappable_model()), ("many", small_model())):
        write_usd_cameras(tmp_path / f"{name}.usdz", undistorted(model), up=UP)
        context = validation.ValidationContext(validation.ValidationRegistry().GetOrLoadAllValidators())
        assert not [error.GetMessage() for error in context.Validate(opened(tmp_path / f"{name}.usdz"))]


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"cameras": mappable_model().cameras}, None, ""),
        ({"cameras": small_model().cameras}, ConfigError, "undistort the images first"),
        (
            {
                "cameras": Cameras.from_list(
                    [Camera("OPENCV_FISHEYE", 640, 480, [500, 500, 320, 240, 0, 0, 0, 0])]
                )
            },
            ConfigError,
            "a camera of USD has no distortion",
        ),
    ],
)
def test_distortion_is_refused(
    tmp_path: Path, change: dict[str, Any], error: type[Exception] | None, words: str
) -> None:
    model = replace(mappable_model(), **change)
    if error is None:
        write_usd_cameras(tmp_path / "a.usda", model)
        return
    with pytest.raises(error, match=words):
        write_usd_cameras(tmp_path / "a.usda", model)
    assert not list(tmp_path.iterdir())


def test_misuse_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = undistorted(mappable_model())
    with pytest.raises(ConfigError, match=r"path must end in \.usdz"):
        write_usd_cameras(tmp_path / "a.obj", model)
    nan = np.full((len(model.frames), 3), np.nan)
    lost = replace(
        model, frames=replace(model.frames, rig_from_world=Rigid3(model.cams_from_world().rotation, nan))
    )
    with pytest.raises(ShapeError, match="no registered image"):
        write_usd_cameras(tmp_path / "a.usda", lost)
    monkeypatch.setitem(__import__("sys").modules, "pxr", None)
    with pytest.raises(MissingDependencyError, match="usd-core"):
        write_usd_cameras(tmp_path / "a.usda", model)
    assert not list(tmp_path.iterdir())
