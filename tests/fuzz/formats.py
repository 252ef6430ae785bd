"""Every format that is read: a valid example, the file of it that is spoilt, its reader, and what is sound."""

import bz2
import io
import json
import os
import shutil
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from example_files import (
    BAL,
    CAMODOCAL,
    EUROC,
    GPS,
    GRAPHS,
    KALIBR,
    KITTI,
    KITTI_ROWS,
    LENS,
    MIDDLEBURY,
    MIDDLEBURY_PAR,
    MRCAL,
    OPENVINS,
    PAIR,
    RGB,
    STRECHA,
    TEXT_MESH,
    TEXT_PLY,
    XML,
    graph_of,
    transforms_text,
)
from PIL import Image, features
from sealed_formats import SEALED
from spz_writing import write_packed_whole, write_streams
from test_io_colmap_database import PAIRS, make_contents

from bag_writing import Recorded
from epipole._checks.tables import TEXT, Expected
from epipole.cameras import Camera
from epipole.errors import ConfigError, DegenerateGeometryError, EpipoleError
from epipole.fields.nerf.hash_field import query_density
from epipole.fields.nerf.hash_files import HashContents, read_hash, write_hash
from epipole.fields.nerf.voxel_files import GridContents, read_grid, write_grid
from epipole.geometry import Rigid2, Rigid3, Rotation3
from epipole.io import (
    read_bal,
    read_bundler,
    read_chan,
    read_colmap_model,
    read_database,
    read_g2o,
    read_kapture,
    read_metashape,
    read_model,
    read_opensfm,
    read_points_ply,
    read_positions,
    read_realityscan,
    read_sequence,
    read_trajectory,
    read_transforms,
    read_truth,
    write_bundler,
    write_chan,
    write_colmap_model,
    write_database,
    write_g2o,
    write_kapture,
    write_metashape,
    write_opensfm,
    write_points_ply,
    write_realityscan,
    write_trajectory,
)
from epipole.io.anchor_files import read_anchor_positions, read_lengths, read_odometry
from epipole.io.bags.recording import bag_frames, read_bag, read_bag_imu, read_bag_topics
from epipole.io.bags.rig_recording import bag_rig_frames, read_bag_rig
from epipole.io.calibration.files import (
    read_body_from_camera,
    read_calibration,
    read_stereo_rig,
    write_calibration,
    write_opencv_yaml,
    write_ros_yaml,
)
from epipole.io.colmap.database import read_matched_pairs
from epipole.io.colmap.rig_config import read_rig_config
from epipole.io.gaussians.files import read_gaussians, write_gaussians
from epipole.io.gaussians.ply import read_gaussian_ply, write_gaussian_ply
from epipole.io.georeference import read_georeference
from epipole.io.images.depth_maps import read_pfm, read_png16, write_pfm, write_png16
from epipole.io.images.exif import new_exif
from epipole.io.images.photographs import copy_or_rotate, read_gray, read_header, read_mask, read_rgb
from epipole.io.images.rgba import read_rgba
from epipole.io.images.video import extract_frames, frame_size
from epipole.io.images.writing import write_jpeg_with_exif
from epipole.io.meshes.gltf import read_glb, write_glb
from epipole.io.meshes.mesh_ply import read_mesh_ply, write_mesh_ply
from epipole.io.models.llff import read_llff
from epipole.io.sequences.imu_logs import read_camera_from_imu, read_imu, read_mounted_imu
from epipole.io.sequences.rig_folders import read_rig_sequence
from epipole.io.sequences.stereo_video import extract_pairs
from epipole.io.survey.control_points import read_control_points
from epipole.io.survey.point_clouds import read_laz, write_laz
from epipole.io.survey.rasters import Raster, read_geotiff, write_geotiff
from epipole.io.trajectories.files import read_pose_matrix, trajectory_format
from epipole.io.trajectories.frame_tables import read_frame_table
from epipole.io.trajectories.true_trajectories import true_path_at
from epipole.pipelines.conversion.run import convert
from epipole.pipelines.evaluation.trajectories import evaluate_trajectory
from epipole.pipelines.fields.kinds import read_neural, read_voxels
from epipole.pipelines.sfm.matching.pairing import read_pairs
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.frames import SlamCamera, TrackedFrame, TrackingState
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.output.answer_log import ANSWERS, line_of, read_answers
from epipole.pipelines.slam.output.known_maps import read_known_maps
from epipole.pipelines.slam.output.map_file import load_slam_map, read_slam_map, write_slam_map
from epipole.pipelines.slam.output.record import FrameRecord
from epipole.pipelines.stereo.files import read_stereo, write_image
from epipole.pipelines.stereo.pairs import read_summary
from epipole.pipelines.surfaces.depth_views import read_depth_views
from epipole.runs import ignore_progress
from epipole.runs.folder import OutputFolder, read_mark
from epipole.runs.source import Source
from epipole.runs.units import load, store, stored_key
from epipole.scene import Georeference, Reconstruction, TexturedMesh, Trajectory
from epipole.scene.gaussian_cloud import GaussianCloud
from hostile_bytes import assert_model, assert_motions
from io_models import mappable_model, small_model


@dataclass(frozen=True)
class Format:
    """A way in which a file can reach a reader."""

    write: Callable[[Path], None]
    """Puts a valid example into a folder."""
    file: str
    """The one that is spoilt."""
    kind: str
    """Of damage."""
    read: Callable[[Path], None]
    """Reads from the folder, and asserts that what comes is sound."""
    readers: tuple[str, ...]
    """Public functions that `read` and `also` call."""
    weight: float = 1.0
    """Share of the cases."""
    must_name: bool = True
    """Whether an error names the folder."""
    most_mib: int = 96
    """Of memory that it may come to use."""
    may_ask: bool = False
    """Whether it may ask for memory that it does not come to use."""
    may_be_refused: bool = False
    """Whether the example may be refused: a file of another program, of a kind that is not read."""
    also: tuple[Callable[[Path], None], ...] = ()
    """Further ways to read it, which go on where `read` has refused it."""


@contextmanager
def _never_refused() -> Iterator[None]:
    """What is read here is done anew, or passed over, where it is damaged."""
    try:
        yield
    except EpipoleError as error:
        raise AssertionError(f"refused: {error}") from error


def _put(name: str, data: bytes) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes(data) and None


def _model(folder: Path) -> None:
    assert_model(read_colmap_model(folder))


def _truth(folder: Path) -> None:
    found = read_truth(folder)
    assert np.isfinite(found.cams_from_world.rotation).all()
    assert_motions(found.cams_from_world)
    assert all(name.encode() for name in found.names)


def _converted(folder: Path) -> None:
    done = convert(folder, folder / "nerf", "transforms")
    assert (done.out / "transforms.json").is_file()


def _database(folder: Path) -> None:
    found = read_database(folder / "database.db")
    pairs = read_matched_pairs(folder / "database.db").tolist()
    assert pairs == sorted([i, j] for (i, j), matches in found.matches.items() if len(matches))
    counts = np.diff(found.images.keypoint_offsets)
    assert (counts >= 0).all() and all(name.encode() for name in found.images.name)
    for (i, j), rows in found.matches.items():
        assert (rows >= 0).all() and (rows < counts[[i, j]]).all()


def _transforms(folder: Path) -> None:
    model = read_transforms(folder / "transforms.json")
    assert_model(model)
    assert all(name.encode() is not None for name in model.images.name)


def _sequence(folder: Path) -> None:
    found = read_sequence(folder)
    times = np.array([frame.timestamp_s for frame in found.frames])
    assert len(found) and np.isfinite(times).all() and (np.diff(times) >= 0).all()
    assert all(folder in frame.image.parents for frame in found.frames)


def _rig(folder: Path) -> None:
    found = read_rig_sequence(folder, 2)
    times = np.array([frame.timestamp_s for frame in found.frames])
    assert len(times) and np.isfinite(times).all() and (np.diff(times) >= 0).all()
    assert all(folder in image.parents for frame in found.frames for image in frame.images)


def _rig_folder(folder: Path) -> None:
    for name in ("cam0", "cam1"):
        (folder / name / "data").mkdir(parents=True, exist_ok=True)
        for n in (1, 2):
            cv2.imwrite(str(folder / name / "data" / f"{n}.png"), np.zeros((8, 8), np.uint8))
        (folder / name / "data.csv").write_text("#timestamp,name\n1000000000,1.png\n1100000000,2.png\n")


def _tum_folder(folder: Path) -> None:
    (folder / "rgb").mkdir(exist_ok=True)
    cv2.imwrite(str(folder / "rgb" / "1.5.png"), np.zeros((8, 8), np.uint8))
    (folder / "rgb.txt").write_text("# color images\n1.5 rgb/1.5.png\n1.6 rgb/1.6.png\n")
    (folder / "depth.txt").write_text("1.501 depth/1.501.png\n1.61 depth/1.61.png\n")


def _euroc_folder(folder: Path) -> None:
    (folder / "cam0" / "data").mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / "cam0" / "data" / "1403.png"), np.zeros((480, 752), np.uint8))
    (folder / "cam0" / "data.csv").write_text("#timestamp [ns],filename\n1403,1403.png\n1404,1404.png\n")
    (folder / "cam0" / "sensor.yaml").write_bytes(EUROC)


def _timed_folder(folder: Path) -> None:
    for n in range(3):
        cv2.imwrite(str(folder / f"{n}.png"), np.zeros((8, 8), np.uint8))
    (folder / "times.txt").write_text("0.0\n0.1\n0.25\n")


def _recorded(kind: str, compression: str = "") -> Callable[[Path], None]:
    """A pair of cameras and an IMU, with what stands first in the file of each kind."""

    def write(folder: Path) -> None:
        recorded = Recorded(kind)
        for n in range(3):
            for side, corner in (("left", 0.0), ("right", -3.0)):
                projection = np.column_stack([LENS.K, [corner, 0, 0]])
                size = (LENS.width, LENS.height)
                recorded.camera_info(f"/{side}/camera_info", 10**18 + n, size, LENS.K, P=projection)
                recorded.image(f"/{side}/image_raw", 10**18 + n, RGB[:8, :8, 0], "mono8")
            recorded.imu("/imu", 10**18 + n, (0, 0, 1), (0, 0, 9.8))
        shutil.rmtree(folder / "ride", ignore_errors=True)
        (folder / "ride.bag").unlink(missing_ok=True)
        recorded.write(folder, compression=compression)

    return write


def _bag(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        path = folder / name
        assert all(topic.num_messages > 0 for topic in read_bag_topics(path))
        bag = read_bag(path)
        for frame in bag_frames(bag):
            assert np.isfinite(frame.timestamp_s)
            with suppress(EpipoleError):  # an image that is damaged is left out
                assert frame.gray().ndim == 2
        with suppress(ConfigError):  # a topic that is damaged
            for frame in bag_rig_frames(read_bag_rig(path, 2)):
                assert np.isfinite(frame.timestamp_s) and len(frame.grays) == 2
                with suppress(EpipoleError):
                    assert frame.grays[1]().ndim == 2
        assert np.isfinite(read_bag_imu(path).accel_m_s2).all()

    return read


def _recording(kind: str, file: str, damage: str, compression: str = "") -> Format:
    readers = ("read_bag", "read_bag_imu", "read_bag_topics", "read_bag_rig")
    path = file.split("/")[0]
    return Format(_recorded(kind, compression), file, damage, _bag(path), readers, weight=0.4, may_ask=True)


def _trajectory(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        found = read_trajectory(folder / name)
        assert len(found) and (np.diff(found.timestamp_s) >= 0).all()
        assert_motions(found.world_from_body)

    return read


def _evaluated(folder: Path) -> None:
    """Commas and nanoseconds suggest that w is first, the numbers that it is last: both files decide."""
    times = 1_400_000_000 + 0.1 * np.arange(6)
    positions = Rigid3.exp(np.linspace(0.0, 1.0, 36).reshape(6, 6) ** 2)
    write_trajectory(Trajectory(times, positions), folder / "truth.txt")
    with suppress(DegenerateGeometryError):  # a path that lost its rows
        found = evaluate_trajectory(folder / "a.csv", folder / "truth.txt", 0.01)
        assert 3 <= found.num_compared <= 6 and np.isfinite(found.similarity.ate_rmse)


def _put_columns(folder: Path) -> None:
    positions = Rigid3.exp(np.linspace(0.0, 1.0, 36).reshape(6, 6) ** 2)
    wxyz = Rotation3(positions.rotation).as_quat_wxyz()
    rows = np.column_stack([positions.translation, wxyz[:, [1, 2, 3, 0]]]).tolist()
    lines = (f"{14 * 10**17 + n * 10**8},{','.join(map(str, row))}\n" for n, row in enumerate(rows))
    (folder / "a.csv").write_text("".join(lines))


def _numbered_folder(folder: Path) -> None:
    for n in range(2):
        cv2.imwrite(str(folder / f"frame-{n:06d}.color.png"), np.zeros((48, 64), np.uint8))
        cv2.imwrite(str(folder / f"frame-{n:06d}.depth.png"), np.full((48, 64), 1500, np.uint16))
    intrinsic = "60 0 32 0 0 60 24 0 0 0 1 0 0 0 0 1"
    (folder / "info.txt").write_text(
        f"m_colorWidth = 64\nm_colorHeight = 48\nm_depthWidth = 64\nm_depthHeight = 48\nm_depthShift = 1000\n"
        f"m_calibrationColorIntrinsic = {intrinsic}\nm_calibrationDepthIntrinsic = {intrinsic.replace('60', '58')}\n"
    )


def _plain_folder(folder: Path) -> None:
    for n in range(2):
        cv2.imwrite(str(folder / f"{n}.png"), np.zeros((48, 64), np.uint8))
    (folder / "intrinsics.txt").write_text("60 0 32\n0 60 24\n0 0 1\n")


def _posed_folder(folder: Path) -> None:
    for n in range(2):
        (folder / f"frame-{n:06d}.pose.txt").write_text("1 0 0 1\n0 1 0 2\n0 0 1 3\n0 0 0 1\n")


def _true_path(folder: Path) -> None:
    assert_motions(true_path_at(folder).trajectory.world_from_body)


def _positions(folder: Path) -> None:
    found = read_positions(folder / "a.txt")
    assert len(found.timestamp_s) == len(found.positions) and (np.diff(found.timestamp_s) > 0).all()
    assert np.isfinite(found.positions).all()


def _lengths(folder: Path) -> None:
    for known in read_lengths(folder / "a.txt"):
        assert 0 < known.length_m < np.inf and all(known.ends)
        assert np.isfinite([pixel for end in known.ends for pixel in end.values()]).all()


def _places(folder: Path) -> None:
    assert np.isfinite(read_anchor_positions(folder / "a.txt").positions).all()


def _control_points(folder: Path) -> None:
    path = next(folder.glob("a.*"))
    found = read_control_points(path)
    assert len(found) and np.isfinite(found.coordinates[:, :2]).all() and np.isfinite(found.pixels).all()
    assert all(0 <= row < len(found) for row in found.point) and len(set(found.name)) == len(found)


def _rig_config(folder: Path) -> None:
    for rig in read_rig_config(folder / "a.json"):
        assert len(rig.sensors) and all(np.isfinite(sensor.params).all() for sensor in rig.sensors)
        for sensor in rig.sensors:
            assert sensor.cam_from_rig is None or np.isfinite(sensor.cam_from_rig.translation).all()


def _georeference(folder: Path) -> None:
    found = read_georeference(folder / "a.json")
    assert abs(found.lat_deg) <= 90 and np.isfinite([found.lon_deg, found.alt_m]).all()


def _odometry(folder: Path) -> None:
    found = read_odometry(folder / "a.txt")
    assert (np.diff(found.timestamp_s) > 0).all() and (found.traveled_m is None) != (found.positions is None)


def _imu(folder: Path) -> None:
    log, noise = read_imu(folder / "a.csv")
    assert len(log) and (np.diff(log.timestamp_s) > 0).all() and noise.gyro_density > 0


def _imu_mounting(folder: Path) -> None:
    assert np.isfinite(read_camera_from_imu(folder / "a.yaml").as_matrix()).all()
    (folder / "imu.csv").write_text("0.5,0.1,0,0,9.8,0,0\n0.505,0,0,1,9,0,1\n")
    found = read_mounted_imu(folder / "imu.csv", folder / "a.yaml")
    assert np.isfinite(found.log.timestamp_s).all() and found.noise.gyro_density > 0


SLAM_CAMERA = SlamCamera(Camera("PINHOLE", 32, 24, [30.0, 30.0, 15.5, 11.5]))


def _put_slam_map(folder: Path) -> None:
    model = SlamMap()
    model.add_points(np.ones((5, 3)), np.full((5, 2), 9.0), 0)
    for n in range(2):
        seen = Observations(np.full((5, 2), 9.0), np.full(5, np.nan), np.arange(5))
        gray = np.full((24, 32), 100 + n, np.uint8)
        model.keyframes.append(Keyframe(n, 0.1 * n, gray, Rigid3.identity(), seen))
    write_slam_map(folder / "map.npz", model, ["a.png", "b.png"], SLAM_CAMERA)


def _slam_map(folder: Path) -> None:
    try:
        known = read_slam_map(folder / "map.npz", SLAM_CAMERA)
        maps = read_known_maps([folder / "map.npz"], SLAM_CAMERA, SlamConfig(), ignore_progress)
        assert maps is not None and maps.first.names == known.names
        assert len(load_slam_map(folder / "map.npz").keyframes) == len(known.names)
    except ConfigError:  # the map of another camera
        return
    assert len(known.names) == len(known.model.keyframes)


def _put_answers(folder: Path) -> None:
    known = Rigid3.identity(), np.eye(6), 30
    answers = [
        TrackedFrame(0.1 * n, TrackingState.TRACKING, "", *known, is_keyframe=n == 0) for n in range(3)
    ]
    lines = [line_of(FrameRecord(n, f"{n}.png", 0.01, answer)) for n, answer in enumerate(answers)]
    (folder / ANSWERS).write_bytes(b"".join(lines))


def _answers(folder: Path) -> None:
    found = read_answers(folder / ANSWERS)
    assert (np.diff([record.number for record in found]) > 0).all()
    for record in found:
        if record.answer is not None and record.answer.world_from_body is not None:
            assert_motions(record.answer.world_from_body)


def _pose_matrix(folder: Path) -> None:
    assert_motions(read_pose_matrix(folder / "a.pose.txt"))


def _frame_table(folder: Path) -> None:
    found = read_frame_table(folder / "frames.csv")
    assert len(found.image) == len(found.timestamp_s)


def _cloud_of(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        found = read_points_ply(folder / name)
        assert found.rgb is None or found.rgb.shape == found.xyz.shape

    return read


_cloud = _cloud_of("cloud.ply")


def _put_mesh(folder: Path) -> None:
    write_mesh_ply(folder / "mesh.ply", np.ones((4, 3)), [[0, 1, 2], [1, 2, 3]], np.zeros((4, 3), np.uint8))


def _mesh(folder: Path) -> None:
    found = read_mesh_ply(folder / "mesh.ply")
    assert found.rgb is None or found.rgb.shape == found.xyz.shape
    assert not len(found.faces) or (found.faces.min() >= 0 and found.faces.max() < len(found.xyz))


def _raster(folder: Path) -> None:
    found = read_geotiff(folder / "a.tif")
    assert np.isfinite([found.x_min, found.y_max, found.resolution_m]).all() and found.resolution_m > 0
    assert found.is_color or not np.isinf(found.values).any()


def _put_heights(folder: Path) -> None:
    values = np.linspace(0, 9, 40 * 30, dtype=np.float32).reshape(40, 30)
    write_geotiff(folder / "a.tif", Raster(values, 500000.0, 5300000.0, 0.5, "EPSG:32632"))


def _put_colors(folder: Path) -> None:
    values = np.arange(600 * 20 * 4, dtype=np.uint32).astype(np.uint8).reshape(600, 20, 4)
    write_geotiff(folder / "a.tif", Raster(values, 500000.0, 5300000.0, 0.5))


def _laz(folder: Path) -> None:
    found = read_laz(folder / "a.laz")
    assert np.isfinite(found.points).all() and len(found.classification) == len(found)
    assert found.rgb is None or found.rgb.shape == found.points.shape
    assert found.sigma is None or len(found.sigma) == len(found)


def _put_laz(folder: Path) -> None:
    points = np.linspace(0, 100, 300).reshape(100, 3) + np.array([500000.0, 5300000.0, 400.0])
    sigma = np.full(100, 0.1, np.float32)
    write_laz(folder / "a.laz", points, np.zeros((100, 3), np.uint8), crs="EPSG:32632", sigma=sigma)


def _put_glb(folder: Path) -> None:
    uv, textures = np.linspace(0, 1, 12).reshape(2, 3, 2), (RGB[:16, :24], RGB[16:32, :8])
    corners = np.array([[5e5, 5e6, 0], [5e5 + 1, 5e6, 0], [5e5, 5e6 + 1, 0], [5e5 + 1, 5e6 + 1, 0]])
    mesh = TexturedMesh(corners, [[0, 1, 2], [2, 1, 3]], uv, [0, 1], textures)
    write_glb(folder / "mesh.glb", mesh, up=[0, 0, 1])


def _glb(folder: Path) -> None:
    found = read_glb(folder / "mesh.glb")
    assert len(found) and all(texture.size for texture in found.textures)
    assert np.isfinite(found.vertices_in_world).all() and np.isfinite(found.uv).all()


def _gaussians(folder: Path) -> None:
    found = read_gaussian_ply(folder / "splat.ply")
    assert len(found) and np.isfinite(found.sh).all() and found.quats_wxyz.any(axis=1).all()


def _put_gaussians(folder: Path) -> None:
    shapes = ((4, 3), (4, 3), (4, 4), (4,), (4, 4, 3))
    arrays = (np.ones(shape, np.float32) for shape in shapes)
    write_gaussian_ply(folder / "splat.ply", GaussianCloud(*arrays))


def _splats(name: str) -> Format:
    def put(folder: Path) -> None:
        rng = np.random.default_rng(0)
        shapes = ((6, 3), (6, 3), (6, 4), (6,), (6, 4, 3))
        cloud = GaussianCloud(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))
        write_gaussians(folder / name, cloud)

    def read(folder: Path) -> None:
        found = read_gaussians(folder / name)
        assert len(found) and np.isfinite(found.sh).all() and found.quats_wxyz.any(axis=1).all()
        assert np.isfinite(found.opacity_logits).all() and np.isfinite(found.log_scales).all()

    kind = {".ply": "ply", ".sog": "zip"}.get(Path(name).suffix, "binary")
    own = {"a.compressed.ply": "read_compressed_ply", "a.spz": "read_spz", "a.sog": "read_sog"}.get(name)
    return Format(put, name, kind, read, ("read_gaussians", *filter(None, [own])))


def _grid(folder: Path) -> None:
    found = read_grid(folder / "grid.npz")
    assert np.isfinite(found.values).all() and found.size > 0 and found.cells.ndim == 3
    voxels = read_voxels(folder / "grid.npz")
    assert voxels.row_of.max() < len(voxels.values)


def _put_grid(folder: Path) -> None:
    cells = np.zeros((3, 4, 5), bool)
    cells[1, 1:3, 2] = True
    values = np.arange(12 * 13, dtype=np.float32).reshape(12, 13)
    write_grid(folder / "grid.npz", GridContents(cells, values, np.zeros(3), 0.5, 0.5))


def _hash(folder: Path) -> None:
    found = read_hash(folder / "hash.npz")
    assert np.isfinite(found.tables).all() and found.size > 0 and found.occupied.ndim == 3
    field = read_neural(folder / "hash.npz")
    assert np.isfinite(query_density(field, np.full((2, 4), 0.4, np.float32))[2]).all()


def _put_hash(folder: Path) -> None:
    sizes = [(8, 3), (3, 16), (32, 3), (3, 3), (3, 3)]
    layers = tuple(np.linspace(-1, 1, a * b).reshape(a, b) for a, b in sizes)
    tables = np.linspace(-1, 1, 2 * 8 * 4).reshape(2, 8, 4)
    contents = HashContents(np.ones((2, 3, 4), bool), np.zeros(3), 0.5, np.array([1, 5]), tables, layers)
    write_hash(folder / "hash.npz", contents)


def _llff(folder: Path) -> None:
    found = read_llff(folder)
    assert_motions(found.reconstruction.frames.rig_from_world)
    assert len(found.near_far) == 2 and (found.near_far > 0).all()


def _put_llff(folder: Path) -> None:
    row = [*np.array([[0, 1, 0, 0, 30], [1, 0, 0, 0, 40], [0, 0, -1, 0, 35]], float).reshape(-1), 1.0, 9.0]
    np.save(folder / "poses_bounds.npy", np.array([row, row]))
    (folder / "images").mkdir(exist_ok=True)
    for name in ("a.png", "b.png"):
        Image.new("RGB", (40, 30)).save(folder / "images" / name)


def _put_llff_points(folder: Path) -> None:
    _put_llff(folder)
    (folder / "sparse").mkdir(exist_ok=True)
    write_colmap_model(small_model(), folder / "sparse" / "0")


def _bal(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        found = read_bal(folder / name)
        assert_motions(found.rig_from_world)
        assert found.offsets[-1] == len(found.frame) == len(found.pixels)

    return read


def _graph(folder: Path) -> None:
    found = read_g2o(folder / "graph.g2o").graph
    assert len(found.first) == len(found.second) == len(found.information)
    if not isinstance(found.world_from_body, Rigid2):
        for motions in (found.world_from_body, found.first_from_second):
            assert np.isfinite(motions.rotation).all()
            assert_motions(motions)


SIZE = (1242, 375)
"""Of the images, which some calibrations leave out."""


def _calibration(*names: str, size: tuple[int, int] | None = None) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        found = read_calibration(*(folder / name for name in names), size=size)
        assert len(found.cameras) == len(found.cam_from_rig) > 0
        assert np.isfinite(found.cam_from_rig.as_matrix()).all()
        assert_motions(found.cam_from_rig)
        for camera in found.cameras:
            assert all(0 < side <= 1 << 20 for side in (camera.width, camera.height))
            assert np.isfinite(camera.params).all()
        if len(found.cameras) > 1:
            assert_motions(read_stereo_rig(*(folder / name for name in names), size=size).right_from_left)

    return read


def _ros(folder: Path) -> None:
    motion = PAIR.cam_from_rig[1]
    projection = np.column_stack([LENS.K, [-60.0, 0.0, 0.0]])
    write_ros_yaml(folder / "left.yaml", LENS, "left")
    write_ros_yaml(folder / "right.yaml", LENS, "right", motion.rotation, projection)


def _opencv_sample(folder: Path) -> None:
    """OpenCV's stereo sample: intrinsics and extrinsics in two files."""
    write_opencv_yaml(folder / "both.yml", PAIR)
    lines = (folder / "both.yml").read_text()
    head, mark, rest = lines.partition("R: !!")
    (folder / "intrinsics.yml").write_text(head)
    (folder / "extrinsics.yml").write_text("%YAML:1.0\n---\n" + mark + rest)


def _euroc_pair(folder: Path) -> None:
    (folder / "a.yaml").write_bytes(EUROC)
    (folder / "b.yaml").write_bytes(EUROC.replace(b"0.0, 0.0, -0.02", b"0.0, 0.0, 0.09"))


def _body(folder: Path) -> None:
    assert_motions(read_body_from_camera(folder / "sensor.yaml"))


def _map(read: Callable[[Path], np.ndarray], name: str) -> Callable[[Path], None]:
    def run(folder: Path) -> None:
        found = read(folder / name)
        assert found.ndim == 2
        if read is read_pfm:
            assert found.size * 4 <= (folder / name).stat().st_size
        else:
            assert not np.isinf(found).any()

    return run


def _image(kind: str) -> bytes:
    stream = io.BytesIO()
    options = {} if kind in ("BMP", "PPM") else {"exif": new_exif("Canon", "Canon EOS 5D", 35.0, GPS)}
    mode = {"form": "JPEG", "progressive": True} if kind == "progressive" else {"form": kind}
    if kind == "TIFF-deflate":
        mode, options = {"form": "TIFF"}, {**options, "compression": "tiff_adobe_deflate"}
    if kind == "APNG":
        more = [Image.fromarray(RGB[::-1].copy())]
        mode, options = {"form": "PNG"}, {**options, "save_all": True, "append_images": more}
    if kind == "PNG-deep":
        Image.fromarray(RGB[..., 0].astype(np.uint16) * 200).save(stream, "PNG")
        return stream.getvalue()
    Image.fromarray(RGB).save(stream, mode.pop("form"), **mode, **options)
    return stream.getvalue()


def _photograph(folder: Path) -> None:
    path = folder / "photograph"
    header = read_header(path)
    assert header.width > 0 and header.height > 0 and 1 <= header.orientation <= 8
    assert header.focal_px is None or 0 < header.focal_px < np.inf
    assert header.gps is None or (abs(header.gps.lat_deg) <= 90 and abs(header.gps.lon_deg) <= 180)
    assert header.gps is None or header.gps.alt_m is None or np.isfinite(header.gps.alt_m)


def _pixels(folder: Path) -> None:
    path = folder / "photograph"
    rgb = read_rgb(path)
    assert rgb.shape[2] == 3 and rgb.dtype == np.uint8
    rgba = read_rgba(path)
    assert rgba is None or rgba.shape[2] == 4


def _small_pixels(folder: Path) -> None:
    path = folder / "photograph"
    for found, axes in ((read_gray(path, 16), 2), (read_rgb(path, 16), 3)):
        assert found.ndim == axes and max(found.shape) <= 16 and found.dtype == np.uint8
    copy_or_rotate(path, folder / "copy.jpg")


def _exif(folder: Path) -> None:
    """A damaged block tells less, or nothing: the image itself is sound and stays readable."""
    with _never_refused():
        _photograph(folder)
        header = read_header(folder / "photograph")
        assert {header.width, header.height} == {24, 32}
        assert header.focal_px is None or 0.2 * 32 <= header.focal_px <= 20 * 32
        assert read_rgb(folder / "photograph").size == RGB.size


def _mask(folder: Path) -> None:
    found = read_mask(folder, "a.jpg")
    assert found is not None and found.dtype == bool


def _video(folder: Path) -> None:
    path = folder / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
    for n in range(4):
        writer.write(np.roll(np.kron(RGB[:12, :16], np.ones((4, 4, 1), np.uint8)), n, axis=1))
    writer.release()


def _frames(folder: Path) -> None:
    size = frame_size(folder / "video.avi")
    assert size is None or min(size) > 0
    found = extract_frames(folder / "video.avi", folder / "frames", max_frames=2)
    assert 1 <= len(found) <= 2 and all((folder / "frames" / name).is_file() for name in found.name)


def _listed(folder: Path) -> None:
    _video(folder)
    extract_frames(folder / "video.avi", folder / "frames", max_frames=2)


def _listed_frames(folder: Path) -> None:
    """A damaged list is read anew from the video, or its frames are there; never a file outside of the folder."""
    with _never_refused():
        _frames(folder)
        found = extract_frames(folder / "video.avi", folder / "frames", max_frames=2)
        assert all(Path(name).name == name for name in found.name)


def _pairs_of_video(folder: Path) -> None:
    path = folder / "video.avi"
    assert 1 <= len(extract_pairs(path, path, folder / "pairs", 2)) <= 2


def _stereo(folder: Path) -> None:
    write_image(folder / "left.png", RGB)
    for name in ("depth.pfm", "sigma_depth.pfm"):
        write_pfm(folder / name, np.ones(RGB.shape[:2]))
    content = {"K": LENS.K.tolist(), "baseline": 0.12, "principal_offset_px": 0.0}
    (folder / "rig.json").write_text(json.dumps(content, indent=1))


def _depths(folder: Path) -> None:
    found = read_stereo(folder)
    assert found.depths.shape == found.left_rgb.shape[:2] and np.isfinite(found.K).all()


def _listed_depths(folder: Path) -> None:
    view = {"name": "a.jpg", "file": "units/depth/a.npz", "width": 64, "height": 48}
    view |= {"fx": 50.0, "fy": 51.0, "cx": 31.5, "cy": 23.5, "cam_from_world": np.eye(4)[:3].tolist()}
    (folder / "depths.json").write_text(json.dumps({"views": [view, view | {"name": "b.jpg"}]}, indent=1))


def _depth_views(folder: Path) -> None:
    for view in read_depth_views(folder):
        assert np.isfinite(view.camera.K).all() and np.isfinite(view.cam_from_world.as_matrix()).all()
        assert folder in view.path.parents


def _summary(folder: Path) -> None:
    with _never_refused():
        found = read_summary(folder)
    assert isinstance(found, dict) and isinstance(found.get("known", {}), dict)


UNIT = {
    "pixels": Expected("float64", "n 2"),
    "names": Expected(TEXT, "_"),
    "rows": Expected("int64", "_", below="n"),
}


def _unit(folder: Path) -> None:
    with _never_refused():  # without its key it is made again
        assert isinstance(stored_key(folder / "unit.npz"), str)
    found = load(folder / "unit.npz", UNIT)
    assert np.isfinite(found["pixels"]).all() and found["rows"].max(initial=-1) < len(found["pixels"])


def _write_unit(folder: Path) -> None:
    arrays = {"pixels": np.ones((3, 2)), "names": np.array(["a", "bc"]), "rows": np.arange(3)}
    store(folder / "unit.npz", "key", arrays)


def _marked(folder: Path) -> None:
    marked = OutputFolder(folder, "reconstruct", Source(("here",), ("0123456789abcdef",)))
    marked.write_json("summary.json", {"num_images": 3})
    marked.timings_s = {"read": 0.25}
    marked.save()


def _mark(folder: Path) -> None:
    found = read_mark(folder)
    if found is not None:
        assert isinstance(found.kind, str)
        assert all(isinstance(name, str) for names in found.files.values() for name in names)
        assert all(isinstance(seconds, float) for seconds in found.timings_s.values())


def _list_of_pairs(folder: Path) -> None:
    found = read_pairs(folder / "pairs.txt", ["a.jpg", "b.jpg", "c.jpg"])
    assert found.shape[1] == 2 and ((found >= 0) & (found < 3)).all()


def _colmap(name: str) -> Format:
    text = name.endswith("txt")

    def write(folder: Path) -> None:
        write_colmap_model(small_model(), folder, text=text)

    return Format(write, name, "text" if text else "binary", _model, ("read_colmap_model", "find_model"))


def _calibrated(kind: str, write: Callable[[Path], None], *names: str, size: Any = None) -> Format:
    readers = ("read_calibration", "read_stereo_rig")
    also = () if size else (_calibration(*names, size=SIZE),)
    return Format(write, names[0], kind, _calibration(*names, size=size), readers, also=also)


def _pictured(kind: str, damage: str = "binary") -> Format:
    readers = ("read_header", "read_rgb", "read_rgba", "read_gray", "copy_or_rotate")
    also = (_pixels, _small_pixels)
    put = _put("photograph", _image(kind))
    return Format(put, "photograph", damage, _photograph, readers, most_mib=160, also=also)


def _points(folder: Path) -> None:
    write_points_ply(folder / "points.ply", np.ones((3, 3)), np.zeros((3, 3), np.uint8))


def _transforms_file(known: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        _points(folder)
        Image.fromarray(RGB).save(folder / "a.png")
        (folder / "images").mkdir(exist_ok=True)
        Image.fromarray(RGB).save(folder / "images" / "a.png")
        (folder / "transforms.json").write_bytes(transforms_text(known))

    return write


def _read_without_warnings(read: Callable[[Path], Any], name: str) -> Callable[[Path], None]:
    """Warnings name what is left out, and stay in the process."""

    def checked_read(folder: Path) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = read(folder / name if name else folder)
        assert_model(model)
        assert all(name.encode() for name in model.images.name)

    return checked_read


def _put_opensfm(folder: Path) -> None:
    write_opensfm(replace(small_model(), georeference=Georeference(48.0, 11.0, 500.0)), folder / OPENSFM)


def _put_metashape(folder: Path) -> None:
    write_metashape(replace(small_model(), georeference=Georeference(48.0, 11.0, 500.0)), folder / METASHAPE)


def _put_bundler(folder: Path) -> None:
    model = mappable_model(3, 12)
    write_bundler(model, folder / BUNDLE)
    for name in model.images.name:
        Image.new("L", (640, 480)).save(folder / name)


def _put_images(folder: Path, model: Reconstruction) -> None:
    for row, name in enumerate(model.images.name):
        camera = model.cameras[int(model.camera_of_image[row])]
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (camera.width, camera.height)).save(folder / "images" / name)


def _put_realityscan(folder: Path) -> None:
    model = small_model()
    write_realityscan(model, folder / REALITYSCAN)
    _put_images(folder, model)


def _put_realityscan_poses(folder: Path) -> None:
    """The export of positions and angles; the focal length is that of EXIF."""
    rows = [f"{name},{n},2,3.5,{40 * n},85,{-n}\n" for n, name in enumerate(("a.jpg", "b.jpg"))]
    (folder / REALITYSCAN).write_text(f"#cameras 2\n#name,x,y,z,heading,pitch,roll\n{''.join(rows)}")
    for name in ("a.jpg", "b.jpg"):
        write_jpeg_with_exif(folder / name, RGB, focal_35mm=27)


def _put_chan(folder: Path) -> None:
    model = mappable_model(4, 12)
    write_chan(model, folder / CHAN)
    _put_images(folder, model)


def _chan_of_size(folder: Path) -> None:
    assert_model(read_chan(folder / CHAN, (64, 48)))


def _put_kapture(folder: Path) -> None:
    write_kapture(small_model(), folder)


OPENSFM, METASHAPE, BUNDLE = "reconstruction.json", "cameras.xml", "bundle.out"
REALITYSCAN, CHAN = "cameras.csv", "shot.chan"
_OPENSFM = _read_without_warnings(read_opensfm, OPENSFM)
_BUNDLER = _read_without_warnings(read_bundler, BUNDLE)
_REALITYSCAN = _read_without_warnings(read_realityscan, REALITYSCAN)
_CHAN = _read_without_warnings(read_chan, CHAN)
_KAPTURE = _read_without_warnings(read_kapture, "")
OTHER_MODELS = {
    "opensfm": Format(_put_opensfm, OPENSFM, "json", _OPENSFM, ("read_opensfm",)),
    "opensfm-tracks": Format(_put_opensfm, "tracks.csv", "text", _OPENSFM, ("read_opensfm",)),
    "opensfm-head": Format(
        _put_opensfm, OPENSFM, "text", _read_without_warnings(read_model, ""), ("read_model",)
    ),
    "metashape": Format(
        *(
            _put_metashape,
            METASHAPE,
            "text",
            _read_without_warnings(read_metashape, METASHAPE),
            ("read_metashape",),
        )
    ),
    "realityscan": Format(_put_realityscan, REALITYSCAN, "text", _REALITYSCAN, ("read_realityscan",)),
    "realityscan-poses": Format(
        _put_realityscan_poses, REALITYSCAN, "text", _REALITYSCAN, ("read_realityscan",), 0.5
    ),
    "realityscan-head": Format(
        _put_realityscan, REALITYSCAN, "text", _read_without_warnings(read_model, ""), ("read_model",), 0.5
    ),
    "chan": Format(_put_chan, CHAN, "text", _CHAN, ("read_chan",), also=(_chan_of_size,)),
    "bundler": Format(_put_bundler, BUNDLE, "text", _BUNDLER, ("read_bundler",)),
    "bundler-list": Format(_put_bundler, "list.txt", "text", _BUNDLER, ("read_bundler",)),
    **{
        f"kapture-{name.split('/')[-1]}": Format(_put_kapture, name, kind, _KAPTURE, ("read_kapture",), 0.5)
        for name, kind in (
            ("sensors/sensors.txt", "text"),
            ("sensors/rigs.txt", "text"),
            ("sensors/trajectories.txt", "text"),
            ("sensors/records_camera.txt", "text"),
            ("reconstruction/points3d.txt", "text"),
            ("reconstruction/observations.txt", "text"),
            ("reconstruction/keypoints/epipole/keypoints.txt", "text"),
            ("reconstruction/keypoints/epipole/a1.jpg.kpt", "binary"),
        )
    },
}

_PARTS = ("cameras", "rigs", "frames", "images", "points3D")

FORMATS: dict[str, Format] = {
    **{
        f"colmap-{part}-{suffix}": _colmap(f"{part}.{suffix}") for part in _PARTS for suffix in ("bin", "txt")
    },
    "database": Format(
        lambda folder: write_database(folder / "database.db", make_contents(small_model(), PAIRS)),
        *("database.db", "sqlite", _database, ("read_database", "read_matched_pairs")),
        weight=2.0,
    ),
    **{
        f"transforms-{known}": Format(
            *(
                _transforms_file(known),
                "transforms.json",
                "json",
                _transforms,
                ("read_transforms", "read_transforms_scene"),
            )
        )
        for known in ("all", "size", "nothing")
    },
    "transforms-points": Format(
        _transforms_file("all"),
        "points.ply",
        "ply",
        _transforms,
        ("read_transforms", "read_transforms_scene"),
        must_name=False,
    ),
    **OTHER_MODELS,
    "convert": Format(
        *(lambda folder: write_colmap_model(small_model(), folder), "images.bin", "binary", _converted),
        readers=("read_model",),
        weight=0.3,
    ),
    "sequence-tum": Format(_tum_folder, "rgb.txt", "text", _sequence, ("read_sequence",)),
    "sequence-tum-depth": Format(_tum_folder, "depth.txt", "text", _sequence, ("read_sequence",)),
    "sequence-euroc": Format(_euroc_folder, "cam0/data.csv", "text", _sequence, ("read_sequence",)),
    "sequence-rig": Format(_rig_folder, "cam1/data.csv", "text", _rig, ("read_rig_sequence",)),
    "sequence-info": Format(_numbered_folder, "info.txt", "text", _sequence, ("read_sequence",)),
    "sequence-intrinsics": Format(_plain_folder, "intrinsics.txt", "text", _sequence, ("read_sequence",)),
    "true-path": Format(_posed_folder, "frame-000001.pose.txt", "text", _true_path, ("true_path_at",)),
    "evaluated-columns": Format(
        _put_columns,
        "a.csv",
        "text",
        _evaluated,
        ("read_trajectory_columns", "read_as", "read_file"),
        must_name=False,
    ),
    "sequence-times": Format(_timed_folder, "times.txt", "text", _sequence, ("read_sequence",)),
    "bag-ros1": _recording("ros1", "ride.bag", "binary"),
    "bag-sqlite": _recording("sqlite", "ride/ride.db3", "sqlite"),
    "bag-mcap": _recording("mcap", "ride/ride.mcap", "binary"),
    "bag-ros1-bz2": _recording("ros1", "ride.bag", "binary", "bz2"),
    "bag-ros1-lz4": _recording("ros1", "ride.bag", "binary", "lz4"),
    "bag-mcap-zstd": _recording("mcap", "ride/ride.mcap", "binary", "storage"),
    "bag-messages-zstd": _recording("sqlite", "ride/ride.db3", "sqlite", "message"),
    "bag-file-zstd": _recording("sqlite", "ride/ride.db3.zstd", "binary", "file"),
    "bag-metadata": _recording("mcap", "ride/metadata.yaml", "yaml"),
    "trajectory-tum": Format(
        _put("a.txt", b"# t\n0.5 1 2 3 0 0 0 1\n0.6 1 2 4 0 0 0.6 0.8\n"),
        "a.txt",
        "text",
        _trajectory("a.txt"),
        ("read_trajectory",),
    ),
    "trajectory-kitti": Format(
        _put("a.txt", b"1 0 0 5 0 1 0 6 0 0 1 7\n" * 3),
        "a.txt",
        "text",
        _trajectory("a.txt"),
        ("read_trajectory",),
    ),
    "trajectory-euroc": Format(
        _put(
            "a.csv",
            b"#t [ns],x\n1403636580838555648,0.1,0.2,0.3,1,0,0,0,0.5\n1403636580888555648,0.1,0.2,0.4,1,0,0,0,0.5\n",
        ),
        *("a.csv", "text", _trajectory("a.csv"), ("read_trajectory",)),
    ),
    "trajectory-format": Format(
        _put("a.txt", b"# t\n0.5 1 2 3 0 0 0 1\n"),
        *("a.txt", "text", lambda folder: trajectory_format(folder / "a.txt"), ("trajectory_format",)),
    ),
    "positions": Format(
        _put("a.txt", b"# t x y z\n0.5 1 2 3\n0.6, 1, 2, 4\n0.7 1 2 5\n"),
        *("a.txt", "text", _positions, ("read_positions",)),
    ),
    "lengths": Format(
        _put("a.txt", b"# n\nL 1.5 a one.jpg 1 2\nL 1.5 b one.jpg 3 4\nL 1.5 a b/c d.jpg 5 6\n"),
        *("a.txt", "text", _lengths, ("read_lengths",)),
    ),
    "places": Format(
        _put("a.txt", b"# n\none.jpg 1 2 3\ntwo.jpg 4 5 6\nd e.jpg 7 8 9\n"),
        *("a.txt", "text", _places, ("read_anchor_positions",)),
    ),
    "control-points": Format(
        _put(
            "a.txt",
            b"WGS84\n# n\n13.4 52.5 12.1 26.2 9.4 2.jpg P1\n13.4 52.5 12.1 23 14 1.jpg P1\n13.5 52.6 NaN 3 4 1.jpg P2\n",
        ),
        *("a.txt", "text", _control_points, ("read_control_points",)),
    ),
    "control-points-json": Format(
        _put(
            "a.json",
            b'{"points": [{"id": "7", "position": {"latitude": 52.5, "longitude": 13.4, "altitude": 14.9},'
            b' "observations": [{"shot_id": "01.jpg", "projection": [-0.004, -0.035]}]}]}',
        ),
        *("a.json", "text", _control_points, ("read_control_points",)),
    ),
    "georeference": Format(
        _put(
            "a.json",
            b'{"lat_deg": 48.2, "lon_deg": 11.6, "alt_m": 520.5, "axes": "east, north, up", "crs": "",'
            b' "sigma_m": [0.02, 0.03, 0.05]}',
        ),
        *("a.json", "text", _georeference, ("read_georeference",)),
    ),
    "rig-config": Format(
        _put(
            "a.json",
            b'[{"cameras": [{"image_prefix": "l/", "ref_sensor": true}, {"image_prefix": "r/", "cam_from_rig_rotation": [1, 0, 0, 0],'
            b' "cam_from_rig_translation": [-0.5, 0, 0], "camera_model_name": "PINHOLE", "camera_params": [5, 5, 3, 2]}]}]',
        ),
        *("a.json", "text", _rig_config, ("read_rig_config",)),
    ),
    "odometry": Format(
        _put("a.txt", b"# s m\n0.5 1\n0.6 1.5\n0.7 2.25\n"),
        *("a.txt", "text", _odometry, ("read_odometry",)),
    ),
    "imu": Format(
        _put(
            "a.csv",
            b"#t [ns],wx,wy,wz,ax,ay,az\n1400000000000000000,0.1,0,0,9.8,0,0\n1400000000005000000,0,0,1,9,0,1\n",
        ),
        *("a.csv", "text", _imu, ("read_imu",)),
    ),
    "imu-mounting": Format(
        _put(
            "a.yaml",
            b"cam0:\n  T_cam_imu:\n  - [1.0, 0.0, 0.0, 0.1]\n  - [0.0, 1.0, 0.0, 0.0]\n"
            b"  - [0.0, 0.0, 1.0, 0.0]\n  - [0.0, 0.0, 0.0, 1.0]\n  timeshift_cam_imu: 0.01\ngyroscope_noise_density: 0.001\n",
        ),
        *("a.yaml", "text", _imu_mounting, ("read_camera_from_imu", "read_mounted_imu")),
    ),
    "slam-map": Format(
        _put_slam_map, "map.npz", "sealed", _slam_map, ("read_slam_map", "load_slam_map", "read_known_maps")
    ),
    "slam-answers": Format(_put_answers, ANSWERS, "answers", _answers, ("read_answers",)),
    "pose-matrix": Format(
        _put("a.pose.txt", b"0 -1 0 5\n1 0 0 6\n0 0 1 7\n0 0 0 1\n"),
        *("a.pose.txt", "text", _pose_matrix, ("read_pose_matrix",)),
    ),
    "frame-table": Format(
        _put("frames.csv", b'frame,timestamp_s,image\n0,0.5,a.png\n1,,"b,c.png"\n'),
        *("frames.csv", "text", _frame_table, ("read_frame_table",)),
    ),
    "truth-strecha": Format(_put("a.png.camera", STRECHA), "a.png.camera", "text", _truth, ("read_truth",)),
    "truth-middlebury": Format(
        _put("t_par.txt", MIDDLEBURY_PAR), "t_par.txt", "text", _truth, ("read_truth",)
    ),
    "ply": Format(
        lambda folder: write_points_ply(folder / "cloud.ply", np.ones((6, 3)), np.zeros((6, 3), np.uint8)),
        *("cloud.ply", "ply", _cloud, ("read_points_ply",)),
    ),
    "mesh": Format(_put_mesh, "mesh.ply", "ply", _mesh, ("read_mesh_ply",)),
    "geotiff-heights": Format(_put_heights, "a.tif", "binary", _raster, ("read_geotiff",)),
    "geotiff-colors": Format(_put_colors, "a.tif", "binary", _raster, ("read_geotiff",)),
    "laz": Format(_put_laz, "a.laz", "binary", _laz, ("read_laz",)),
    "mesh-text": Format(_put("mesh.ply", TEXT_MESH), "mesh.ply", "text", _mesh, ("read_mesh_ply",)),
    "mesh-glb": Format(_put_glb, "mesh.glb", "binary", _glb, ("read_glb",)),
    "mesh-glb-text": Format(_put_glb, "mesh.glb", "text", _glb, ("read_glb",), weight=0.5),
    "grid": Format(_put_grid, "grid.npz", "zip", _grid, ("read_grid", "read_voxels")),
    "hash": Format(_put_hash, "hash.npz", "zip", _hash, ("read_hash", "read_neural")),
    "llff": Format(_put_llff, "poses_bounds.npy", "binary", _llff, ("read_llff",)),
    "llff-points": Format(
        *(_put_llff_points, "sparse/0/points3D.bin", "binary", _llff, ("read_llff", "read_binary_points"))
    ),
    **{name: _splats(name) for name in ("a.compressed.ply", "a.spz", "a.sog", "a.splat")},
    "splat": Format(_put_gaussians, "splat.ply", "ply", _gaussians, ("read_gaussian_ply",)),
    "ply-text": Format(_put("cloud.ply", TEXT_PLY), "cloud.ply", "text", _cloud, ("read_points_ply",)),
    "bal": Format(_put("a.txt", BAL), "a.txt", "text", _bal("a.txt"), ("read_bal",)),
    "bal-bz2": Format(
        _put("a.txt.bz2", bz2.compress(BAL)), "a.txt.bz2", "bz2", _bal("a.txt.bz2"), ("read_bal",)
    ),
    **{
        f"g2o-{dimension}": Format(
            lambda folder, kind=kind, size=dimension: write_g2o(folder / "graph.g2o", graph_of(kind, size)),
            *("graph.g2o", "text", _graph, ("read_g2o",)),
        )
        for kind, dimension in GRAPHS
    },
    "calibration-own": _calibrated(
        "json", lambda folder: write_calibration(folder / "a.json", PAIR), "a.json"
    ),
    "calibration-opencv": _calibrated("yaml", lambda f: write_opencv_yaml(f / "a.yml", PAIR), "a.yml"),
    "calibration-opencv-two": _calibrated("yaml", _opencv_sample, "intrinsics.yml", "extrinsics.yml"),
    "calibration-ros": _calibrated("yaml", _ros, "left.yaml", "right.yaml"),
    "calibration-openvins": _calibrated("yaml", _put("a.yaml", OPENVINS), "a.yaml"),
    "calibration-camodocal": _calibrated("yaml", _put("a.yaml", CAMODOCAL), "a.yaml"),
    "calibration-mrcal": _calibrated("text", _put("a.cameramodel", MRCAL), "a.cameramodel"),
    "calibration-kalibr": _calibrated("yaml", _put("a.yaml", yaml.safe_dump(KALIBR).encode()), "a.yaml"),
    "calibration-euroc": _calibrated("yaml", _euroc_pair, "a.yaml", "b.yaml"),
    "calibration-euroc-body": Format(
        *(lambda folder: (folder / "sensor.yaml").write_bytes(EUROC), "sensor.yaml", "yaml", _body),
        ("read_body_from_camera",),
    ),
    "calibration-xml": _calibrated("text", _put("a.xml", XML), "a.xml"),
    "calibration-kitti": _calibrated("text", _put("calib.txt", KITTI), "calib.txt"),
    "calibration-kitti-rows": _calibrated("text", _put("c.txt", KITTI_ROWS), "c.txt", size=SIZE),
    "calibration-middlebury": _calibrated("text", _put("calib.txt", MIDDLEBURY), "calib.txt"),
    "pfm": Format(
        lambda folder: write_pfm(folder / "map.pfm", np.arange(12.0).reshape(3, 4)),
        *("map.pfm", "pfm", _map(read_pfm, "map.pfm"), ("read_pfm",)),
    ),
    "png16": Format(
        lambda folder: write_png16(folder / "map.png", np.arange(1.0, 13.0).reshape(3, 4)),
        *("map.png", "png", _map(read_png16, "map.png"), ("read_png16",)),
    ),
    **{f"picture-{kind}": _pictured(kind) for kind in ("TIFF", "TIFF-deflate", "WEBP", "BMP", "PPM")},
    **{f"picture-{kind}": _pictured(kind, "png") for kind in ("PNG", "APNG", "PNG-deep")},
    **{f"picture-{kind}": _pictured(kind, "jpeg") for kind in ("JPEG", "progressive")},
    **({"picture-AVIF": _pictured("AVIF")} if features.check("avif") else {}),
    "exif": Format(_put("photograph", _image("JPEG")), "photograph", "exif", _exif, ("read_header",)),
    "mask": Format(
        _put("a.jpg.png", _image("PNG")), "a.jpg.png", "png", _mask, ("read_mask", "read_mask_file")
    ),
    "video": Format(_video, "video.avi", "binary", _frames, ("extract_frames", "frame_size"), weight=0.3),
    "video-pairs": Format(_video, "video.avi", "binary", _pairs_of_video, ("extract_pairs",), weight=0.3),
    "video-list": Format(
        _listed, "frames/frames.json", "json", _listed_frames, ("extract_frames",), weight=0.3
    ),
    "stereo-rig": Format(_stereo, "rig.json", "json", _depths, ("read_stereo",)),
    "stereo-depth": Format(_stereo, "depth.pfm", "pfm", _depths, ("read_stereo",)),
    "stereo-sigma": Format(_stereo, "sigma_depth.pfm", "pfm", _depths, ("read_stereo",)),
    "stereo-picture": Format(_stereo, "left.png", "png", _depths, ("read_stereo",)),
    "stereo-summary": Format(
        _put("summary.json", b'{"done": ["a"], "known": {"a": 0.5}, "warnings": {}, "problems": {"b": "c"}}'),
        *("summary.json", "json", _summary, ("read_summary",)),
    ),
    "depth-list": Format(_listed_depths, "depths.json", "json", _depth_views, ("read_depth_views",)),
    "unit": Format(_write_unit, "unit.npz", "sealed", _unit, ("load", "stored_key"), may_ask=True),
    "mark": Format(_marked, "epipole.json", "json", _mark, ("read_mark",)),
    "pairs": Format(
        _put("pairs.txt", b"# pairs\na.jpg b.jpg\nb.jpg c.jpg\n"),
        *("pairs.txt", "text", _list_of_pairs, ("read_pairs",)),
    ),
}
FORMATS |= {
    name: Format(
        *(
            write,
            file,
            "sealed",
            read,
            ("load_features", "load_putative", "load_view_graph", "load_part"),
            weight,
        ),
        most_mib=160,  # trainings go on in some
    )
    for name, (write, file, read, weight) in SEALED.items()
}


def _any_gaussians(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        found = read_gaussians(folder / name)
        assert len(found) and np.isfinite(found.sh).all() and found.quats_wxyz.any(axis=1).all()

    return read


FAULTS = Path(os.environ.get("EPIPOLE_DATA", Path(__file__).parents[3] / "shared" / "data")) / "faults"
"""Small files of other programs, where they are."""


def _foreign(name: str, kind: str, read: Callable[[str], Callable[[Path], None]]) -> dict[str, Format]:
    """A file of another program as the example, where it is."""
    source = FAULTS / name
    if not source.is_file():
        return {}
    file = source.name

    def write(folder: Path) -> None:
        for beside in sorted(source.parent.iterdir()) if source.parent != FAULTS else [source]:
            shutil.copyfile(beside, folder / beside.name)

    return {f"foreign-{name}": Format(write, file, kind, read(file), (), may_be_refused=True)}


FORMATS |= {
    "spz-2": Format(
        lambda folder: write_packed_whole(folder / "other.spz", 2, 6, 1),
        *("other.spz", "binary", _any_gaussians("other.spz"), ("read_gaussians",)),
    ),
    "spz-4": Format(
        lambda folder: write_streams(folder / "other.spz", 6, 2),
        *("other.spz", "binary", _any_gaussians("other.spz"), ("read_gaussians",)),
    ),
    **{
        name: form
        for file in ("minimal-v2.spz", "minimal-v3.spz", "minimal-v4.spz", "minimal.splat")
        for name, form in _foreign(file, "binary", _any_gaussians).items()
    },
    **_foreign("colours_float255.ply", "ply", _cloud_of),
    **_foreign("colours_ushort.ply", "ply", _cloud_of),
    **{
        name: form
        for file in ("euroc_wfirst.txt", "orbslam3_ns.txt", "truth_tum.txt", "tum_order_ns.csv")
        for name, form in _foreign(file, "text", _trajectory).items()
    },
    **_foreign("ros_ost_camera_model_fisheye.yaml", "yaml", _calibration),
    **_foreign(
        "transforms_angle_y.json", "json", lambda name: lambda f: assert_model(read_transforms(f / name))
    ),
    **_foreign(
        "transforms_equirectangular.json",
        "json",
        lambda name: lambda f: assert_model(read_transforms(f / name)),
    ),
    **_foreign("two_fixes.g2o", "text", lambda name: lambda f: read_g2o(f / name)),
    **_foreign("model_fisheye180/cameras.txt", "text", lambda _: _model),
}
