"""One valid call of every job, and of the classes that their options and frames are given in, on small files of the process."""

import atexit
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import epipole
from epipole.cameras import Camera, CameraModel
from epipole.config import AnchorOptions
from epipole.fields.config import NerfTraining, SplatTraining
from epipole.geometry import Rigid3
from epipole.lesson.run import export_lesson
from epipole.pipelines.calibration.config import CalibrationConfig
from epipole.pipelines.fields.comparison import compare_fields
from epipole.pipelines.fields.config import FieldOptions, MeshConfig, NerfConfig, RenderConfig, SplatConfig
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.slam.config import CameraOptions, JobOptions, OdometryConfig, SlamConfig
from epipole.pipelines.slam.frames import DepthCamera, Frame, SlamCamera
from epipole.pipelines.slam.output.map_file import read_slam_map
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.stereo.config import StereoConfig
from epipole.pipelines.stereo.run import examine_stereo, stereo_many, stereo_of_model
from epipole.runs import Job, open_run
from epipole.scene import RectifiedRig

Row = tuple[str, Callable[..., Any], dict[str, Any]]
LENS = Camera(CameraModel.PINHOLE, 64, 48, np.array([60.0, 60.0, 31.5, 23.5]))
OPTIONS = (
    *(
        AnchorOptions,
        CalibrationConfig,
        CameraOptions,
        FieldOptions,
        JobOptions,
        MeshConfig,
        NerfConfig,
        NerfTraining,
        ReconstructConfig,
    ),
    *(OdometryConfig, RenderConfig, SlamConfig, SplatConfig, SplatTraining, StereoConfig),
)


def calls() -> Iterator[Row]:
    """A row of each: name, function, arguments."""
    for kind in OPTIONS:
        usual = kind()
        yield _row(kind, **{field.name: getattr(usual, field.name) for field in fields(kind) if field.init})
    yield from _jobs()
    yield from _frames()


def _row(function: Callable[..., Any], /, **arguments: Any) -> Row:
    return function.__qualname__, function, arguments


@cache
def folder() -> Path:
    """Of this process, gone with it."""
    path = Path(tempfile.mkdtemp(prefix="valid-jobs-"))
    atexit.register(shutil.rmtree, path, ignore_errors=True)
    rng = np.random.default_rng(0)
    (path / "images").mkdir()
    for n in range(3):
        coarse = rng.integers(0, 256, (12, 16, 3)).astype(np.uint8)
        cv2.imwrite(str(path / "images" / f"{n}.png"), cv2.resize(coarse, (64, 48)))
    path.joinpath("path.txt").write_text("".join(f"{n} {n} 0 0 0 0 0 1\n" for n in range(4)))
    return path


def _jobs() -> Iterator[Row]:
    here = folder()
    images, path = here / "images", here / "path.txt"
    left, right = images / "0.png", images / "1.png"
    rig = RectifiedRig(60.0, 31.5, 23.5, 0.1)
    yield _row(epipole.reconstruct, images=images, out=here / "out1", config=ReconstructConfig())
    yield _row(
        epipole.slam,
        source=images,
        out=here / "out2",
        config=SlamConfig(),
        camera_params="60,60,32,24",
    )
    yield _row(epipole.stereo, left=left, right=right, out=here / "out3", config=StereoConfig(), rig=rig)
    yield _row(stereo_many, left=images, right=images, out=here / "out4", config=StereoConfig(), rig=rig)
    yield _row(
        stereo_of_model,
        workspace=here / "out1",
        first="0.png",
        second="1.png",
        out=here / "out5",
        config=StereoConfig(),
    )
    yield _row(examine_stereo, left=images, right=images, rig=rig, max_frames=2)
    yield _row(epipole.calibrate, images=images, out=here / "out6", config=CalibrationConfig(), right=None)
    yield _row(epipole.splat, source=images, config=SplatConfig(steps=1), out=here / "field")
    for job in (epipole.nerf, compare_fields):
        yield _row(job, source=images, config=NerfConfig(steps=1), out=here / "field")
    yield _row(epipole.render, source=images, out=here / "out7")
    yield _row(epipole.mesh, source=images, out=here / "out8")
    yield _row(epipole.convert, source=path, target=here / "converted.txt", format="ply")
    yield _row(epipole.evaluate, out=here / "out9", truth=path)
    yield _row(epipole.evaluate_trajectory, estimate=path, truth=path, max_difference_s=0.01)
    yield _row(epipole.load, path=path)
    blank = np.zeros((12, 16, 3), np.uint8)
    yield _row(epipole.match_stereo, left=blank, right=blank, config=StereoConfig())
    yield _row(epipole.undistort, out=here / "out10", target=here / "undistorted", model=0)
    yield _row(epipole.share, out=path, file=here / "page.html", share_max=100)
    yield _row(export_lesson, folder=here / "lesson")
    yield "view and stop", _view, {"out": path, "port": 8097, "host": "127.0.0.1"}
    yield _row(read_slam_map, path=here / "map.npz", sensor=SlamCamera(LENS))
    job = {"kind": "slam", "inputs": (images,), "settings": {"seed": 0}}
    yield _row(Job, **job, threads=None, executor="threads", opencv_alone=False)
    yield "open a run", _opened, {"job": Job(**job), "out": here / "run"}


def _opened(job: Any, out: Any) -> None:
    with open_run(job, out):
        pass


def _view(out: Any, port: Any, host: Any) -> None:
    epipole.view(out, port=port, host=host, block=False).stop()


def _frames() -> Iterator[Row]:
    gray = np.random.default_rng(1).integers(0, 256, (48, 64)).astype(np.uint8)
    depth = np.full((48, 64), 2.0, np.float32)
    deep = DepthCamera(LENS, Rigid3.identity(), 1.0)
    yield _row(DepthCamera, camera=LENS, depth_from_color=Rigid3.identity(), scale=1.0)
    yield _row(SlamCamera, camera=LENS, baseline=None, depth=deep, readout_s=0.0)
    yield _row(Frame, timestamp_s=0.0, gray=gray, right_gray=None, depth=depth, ignored_mask=depth > 3)
    yield _row(Slam, camera=SlamCamera(LENS), config=SlamConfig(), known=None, is_map_fixed=False, imu=None)
    for name, sensor in (("mono", SlamCamera(LENS)), ("depth", SlamCamera(LENS, None, deep))):
        frame = Frame(0.0, gray, None, None if name == "mono" else depth)
        yield f"Slam.track of {name}", _track(sensor), {"frame": frame}


def _track(sensor: SlamCamera) -> Callable[..., Any]:
    def track(frame: Any) -> Any:
        return Slam(sensor).track(frame)

    return track
