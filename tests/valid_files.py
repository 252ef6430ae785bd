"""One valid call of every function of `epipole.io` that people call, on small files in a folder of the process."""

import atexit
import shutil
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from epipole import io
from epipole.cameras import Camera, CameraModel
from epipole.fields.nerf import hash_files, voxel_files
from epipole.geometry import Rigid3
from epipole.io import anchor_files, json_files, ros
from epipole.io import georeference as georeference_files
from epipole.io.bags import writing as bag_writing
from epipole.io.calibration import camera_params
from epipole.io.calibration import files as calibration_files
from epipole.io.colmap import rig_config
from epipole.io.gaussians import compressed_ply, morton, sog, spz
from epipole.io.gaussians import files as gaussian_files
from epipole.io.gaussians import ply as gaussian_ply
from epipole.io.images import depth_maps, exif, photographs, sensor_widths, video, video_files
from epipole.io.images import image_names as picture_names
from epipole.io.images import rgba as rgba_pictures
from epipole.io.images import writing as photograph_writing
from epipole.io.meshes import gltf, mesh_ply, obj, ply, textured_ply
from epipole.io.models import llff
from epipole.io.models import transforms as transforms_json
from epipole.io.sequences import imu_logs, stereo_folders
from epipole.io.survey import control_points, coordinate_systems, point_clouds, rasters
from epipole.io.trajectories import files as trajectories
from epipole.io.trajectories import frame_tables
from epipole.scene import Georeference, TexturedMesh, Trajectory
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.synthetic import problems

Row = tuple[str, Callable[..., Any], dict[str, Any]]
LENS = Camera(CameraModel.PINHOLE, 16, 12, np.array([15.0, 15.0, 7.5, 5.5]))


def _row(function: Callable[..., Any], /, **arguments: Any) -> Row:
    return function.__qualname__, function, arguments


@cache
def folder() -> Path:
    """Of this process; it goes with it."""
    out = Path(tempfile.mkdtemp(prefix="epipole-valid-"))
    atexit.register(shutil.rmtree, out, ignore_errors=True)
    return out


def _text(name: str, content: str) -> Path:
    path = folder() / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content, encoding="utf-8")
    return path


@cache
def cloud() -> GaussianCloud:
    """Six Gaussians."""
    rng = np.random.default_rng(0)
    shapes = ((6, 3), (6, 3), (6, 4), (6,), (6, 4, 3))
    return GaussianCloud(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))


@cache
def grid() -> voxel_files.GridContents:
    """Two cells."""
    cells = np.zeros((3, 4, 5), bool)
    cells[1, 1:3, 2] = True
    return voxel_files.GridContents(cells, np.ones((12, 13), np.float32), np.zeros(3), 0.5, 0.5)


@cache
def neural() -> hash_files.HashContents:
    """A tiny field."""
    sizes = [(8, 3), (3, 16), (32, 3), (3, 3), (3, 3)]
    layers = tuple(np.linspace(-1, 1, a * b).reshape(a, b).astype(np.float32) for a, b in sizes)
    tables = np.linspace(-1, 1, 64).reshape(2, 8, 4).astype(np.float32)
    return hash_files.HashContents(
        np.ones((2, 3, 4), bool), np.zeros(3), 0.5, np.array([1, 5]), tables, layers
    )


@cache
def trajectory() -> Trajectory:
    """Four poses."""
    return Trajectory(np.arange(4.0), Rigid3.exp(0.1 * np.arange(24.0).reshape(4, 6)))


def calls() -> Iterator[Row]:
    """Of readers and writers."""
    for rows in (_models, _tables, _calibrations, _images, _gaussians, _messages, _names):
        yield from rows()


def _models() -> Iterator[Row]:
    at, model = folder(), problems.bundle_problem(4, 20, 3, 0.3, 3).start
    for name, write, more in (
        ("colmap", io.write_colmap_model, {"text": True}),
        ("scene.ply", io.write_scene_ply, {}),
        ("transforms.json", io.write_transforms, {"image_folder": "images", "origin_in_world": np.ones(3)}),
        ("bundler.out", io.write_bundler, {"image_folder": "images"}),
        ("reconstruction.json", io.write_opensfm, {}),
        ("cameras.xml", io.write_metashape, {}),
        ("cameras.csv", io.write_realityscan, {}),
        ("kapture", io.write_kapture, {}),
    ):
        position = "folder" if write in (io.write_colmap_model, io.write_kapture) else "path"
        write(**{"reconstruction": model, position: at / name})
        yield _row(write, **{"reconstruction": model, position: at / name}, **more)
    yield _row(io.read_colmap_model, folder=at / "colmap")
    yield _row(io.read_model, source=at / "colmap")
    yield _row(io.read_transforms, path=at / "transforms.json", image_folder="images")
    yield _row(transforms_json.read_transforms_scene, path=at / "transforms.json", image_folder="images")
    yield _row(io.read_opensfm, path=at / "reconstruction.json")
    yield _row(io.read_metashape, path=at / "cameras.xml")
    yield _row(io.read_kapture, folder=at / "kapture")
    (at / "images").mkdir(exist_ok=True)  # the list that `write_bundler` writes may lead there
    for row, name in enumerate(model.images.name):
        camera = model.cameras[int(model.camera_of_image[row])]
        for file in (at / name, at / "images" / name):
            cv2.imwrite(str(file), np.zeros((camera.height, camera.width), np.uint8))
    yield _row(io.read_realityscan, path=at / "cameras.csv")
    yield _row(io.read_bundler, path=at / "bundler.out", image_folder="images")
    (at / "shot.chan").write_text("1 0 0 0 10 20 30 40\n2 1 0 0 10 20 30 40\n")
    frames = io.read_chan(at / "shot.chan", (64, 48))
    yield _row(io.read_chan, path=at / "shot.chan", size=(64, 48))
    yield _row(io.write_chan, reconstruction=frames, path=at / "again.chan")
    yield _row(ply.num_cameras_of_scene, path=at / "scene.ply")
    for function in (io.params_to_colmap, io.params_from_colmap):
        yield _row(function, model=int(LENS.model), params=LENS.params)
    database = io.DatabaseContents(
        model.cameras,
        model.rigs,
        model.frames,
        model.images,
        None,
        {(0, 1): np.array([[0, 1]], np.int32)},
        None,
    )
    io.write_database(at / "database.db", database)
    yield _row(io.write_database, path=at / "other.db", contents=database)
    yield _row(io.read_database, path=at / "database.db")
    yield _row(io.DatabaseContents, **{name: getattr(database, name) for name in database.__slots__})
    _text("truth/a.png.camera", "9 0 4\n0 9 3\n0 0 1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 1\n8 6\n")
    yield _row(io.read_truth, path=at / "truth")


def _tables() -> Iterator[Row]:
    at = folder()
    for format in ("tum", "kitti", "euroc"):
        given = {"trajectory": trajectory(), "path": at / f"path.{format}", "format": format}
        io.write_trajectory(**given)
        yield f"write_trajectory of {format}", io.write_trajectory, given | {"with_covariance": False}
        yield (
            f"read_trajectory of {format}",
            io.read_trajectory,
            {"path": at / f"path.{format}", "format": format},
        )
    yield _row(trajectories.trajectory_format, path=at / "path.tum")
    yield _row(
        trajectories.read_pose_matrix, path=_text("a.pose.txt", "1 0 0 5\n0 1 0 6\n0 0 1 7\n0 0 0 1\n")
    )
    yield _row(io.read_positions, path=_text("positions.txt", "0.5 1 2 3\n0.6 1 2 4\n0.7 1 2 5\n"))
    yield _row(
        anchor_files.read_lengths, path=_text("lengths.txt", "L 1.5 a one.jpg 1 2\nL 1.5 b one.jpg 3 4\n")
    )
    rig = _text("rig.json", '[{"cameras": [{"image_prefix": "a/", "ref_sensor": true}]}]')
    yield _row(rig_config.read_rig_config, path=rig)
    gcp = _text("gcp_list.txt", "WGS84\n13.4 52.5 12 26 9 a.jpg P1\n")
    yield _row(control_points.read_control_points, path=gcp)
    yield _row(coordinate_systems.coordinate_system_of, path=gcp, words="WGS84")
    table = np.array([[52.5, 13.4, 12.0]])
    yield _row(coordinate_systems.lat_lon_alt_of, path=gcp, coordinates=table[:, [1, 0, 2]], crs="")
    yield _row(coordinate_systems.coordinates_of, lat_lon_alt=table, crs="")
    origin = Georeference(52.5, 13.4, 12.0)
    yield _row(georeference_files.georeference_fields, georeference=origin)
    yield _row(
        georeference_files.georeference_of_fields,
        path="a.json",
        content=georeference_files.georeference_fields(origin),
    )
    yield _row(georeference_files.write_georeference, path=folder() / "o.json", georeference=origin)
    there = _text("georeference.json", '{"lat_deg": 1, "lon_deg": 2, "alt_m": 3}')
    yield _row(georeference_files.read_georeference, path=there)
    yield _row(
        anchor_files.read_anchor_positions,
        path=_text("places.txt", "one.jpg 1 2 3\ntwo.jpg 4 5 6\nd.jpg 7 8 9\n"),
    )
    yield _row(anchor_files.read_odometry, path=_text("odometry.txt", "0.5 1\n0.6 1.5\n0.7 2.25\n"))
    imu = "#t [ns],wx,wy,wz,ax,ay,az\n1400000000000000000,0.1,0,0,9.8,0,0\n1400000000005000000,0,0,1,9,0,1\n"
    yield _row(imu_logs.read_imu, path=_text("imu.csv", imu))
    mounting = "cam0:\n  T_cam_imu: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    yield _row(imu_logs.read_camera_from_imu, path=_text("mounting.yaml", mounting))
    files = {"path": _text("imu_of.csv", imu), "mounting": _text("mounting_of.yaml", mounting)}
    yield _row(imu_logs.read_mounted_imu, **files, units="", topic="")
    yield _row(
        frame_tables.read_frame_table, path=_text("frames.csv", "frame,timestamp_s,image\n0,0.5,a.png\n")
    )
    yield _row(json_files.json_values, path=at / "a.json", text="[1, 2]", allow_nan=False)
    graph = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
    yield _row(io.read_g2o, path=_text("graph.g2o", graph), indefinite="refuse")
    problem = "1 1 1\n0 0 1.5 2.5\n" + "\n".join(["0.1"] * 6 + ["500", "0", "0", "1", "2", "-9"]) + "\n"
    bal = io.read_bal(_text("a.bal", problem))
    yield _row(io.read_bal, path=at / "a.bal")
    yield _row(io.write_bal, path=at / "b.bal", problem=bal)


def _calibrations() -> Iterator[Row]:
    at = folder()
    one = calibration_files.CalibrationFile((LENS,), Rigid3.identity(1), None)
    both = Rigid3(np.stack([np.eye(3)] * 2), np.array([[0.0, 0, 0], [-0.1, 0, 0]]))
    pair = calibration_files.CalibrationFile((LENS, LENS), both, None)
    calibration_files.write_calibration(at / "pair.json", pair)
    calibration_files.write_calibration(at / "one.json", one)
    yield _row(calibration_files.CalibrationFile, cameras=(LENS, LENS), cam_from_rig=both, covariance=None)
    yield _row(calibration_files.write_calibration, path=at / "other.json", calibration=pair, about={"a": 1})
    yield _row(calibration_files.write_opencv_yaml, path=at / "other.yml", calibration=pair)
    yield _row(
        calibration_files.write_ros_yaml, path=at / "ros.yaml", camera=LENS, name="left",
        rectification=np.eye(3), projection=np.eye(3, 4),
    )  # fmt: skip
    name, function, arguments = _row(calibration_files.read_stereo_rig, path=at / "pair.json", size=(16, 12))
    yield (
        name,
        lambda path, size, cameras: function(path, size=size, cameras=cameras),
        arguments | {"cameras": (0, 1)},
    )
    name, function_of_one, arguments = _row(
        calibration_files.read_calibration, path=at / "one.json", size=(16, 12)
    )
    yield name, lambda path, size: function_of_one(path, size=size), arguments
    yield _row(camera_params.params_of_text, text="1,2,3,4")
    yield _row(camera_params.camera_of_text, model=LENS.model, size=(16, 12), text="15,15,7.5,5.5")
    yield _row(camera_params.text_of_camera, camera=LENS)
    yield _row(camera_params.refuse_impossible, camera=LENS, where="here")
    yield _row(sensor_widths.sensor_width_mm, make="Canon", model="Canon EOS 5D")
    yield _row(exif.new_exif, make="a", model="b", focal_35mm=35.0, gps=(1.0, 2.0, 3.0))


def _images() -> Iterator[Row]:
    at, rgb = folder(), np.arange(12 * 16 * 3, dtype=np.uint8).reshape(12, 16, 3)
    for side in ("left", "right"):
        (at / side).mkdir(exist_ok=True)
        for n in range(2):
            cv2.imwrite(str(at / side / f"{n}.png"), rgb)
    png, depth = at / "left" / "0.png", np.arange(12.0).reshape(3, 4)
    depth_maps.write_pfm(at / "a.pfm", depth)
    depth_maps.write_png16(at / "a16.png", depth + 1.0)
    yield _row(depth_maps.write_pfm, path=at / "b.pfm", values=depth)
    yield _row(depth_maps.read_pfm, path=at / "a.pfm")
    yield _row(depth_maps.write_png16, path=at / "b16.png", values=depth + 1.0, scale=256.0)
    yield _row(depth_maps.read_png16, path=at / "a16.png", scale=256.0)
    yield _row(photographs.list_photographs, folder=at / "left", ignore=(at / "right",))
    yield _row(photographs.read_header, path=png)
    limits = photographs.GrayRange(0.0, 255.0)
    yield _row(photographs.read_gray, path=png, max_size_px=8)
    yield _row(photographs.read_rgb, path=png, max_size_px=8)
    for function in (photographs.read_gray, photographs.read_rgb):
        name = f"{function.__name__} within limits"
        yield (
            name,
            lambda path, limits, read=function: read(path, limits=limits),
            {"path": at / "a16.png", "limits": limits},
        )
    yield _row(photographs.read_mask_file, path=png, name="0.png")
    yield _row(photographs.mask_of, mask_folder=at / "left", name="0.png")
    yield _row(photographs.read_mask, mask_folder=at / "left", name="0.png", size=(16, 12))
    yield _row(photographs.copy_or_rotate, source=png, target=at / "copy.png")
    yield _row(photographs.link_or_copy, source=png, target=at / "linked.png")
    for name in ("written.png", "written.jpg"):
        yield (
            f"write_photograph to {name}",
            photograph_writing.write_photograph,
            {"path": at / name, "pixels": rgb},
        )
    yield _row(photograph_writing.encoded_photograph, path=at / "encoded.png", pixels=rgb)
    gps = {"focal_35mm": 35.0, "make": "a", "model": "b", "gps": (1.0, 2.0, 3.0)}
    yield _row(photographs.write_jpeg_with_exif, path=at / "a.jpg", rgb=rgb, **gps)
    yield _row(rgba_pictures.read_rgba, path=png)
    yield _row(rgba_pictures.write_png, path=at / "b.png", rgb=rgb)
    yield _row(stereo_folders.pair_folders, left=at / "left", right=at / "right", ignore=())
    yield _row(stereo_folders.pair_within, folder=at)
    yield _row(io.read_sequence, folder=at / "left", fps=10.0)
    video_files.write_video(at / "a.mp4", [rgb] * 3, 10.0)
    yield _row(video_files.write_video, path=at / "b.mp4", images=[rgb] * 3, fps=10.0)
    yield _row(video.is_video, path=at / "a.mp4")
    yield _row(video.frame_size, path=at / "a.mp4")
    yield _row(video.extract_frames, video=at / "a.mp4", folder=at / "extracted", max_frames=2, every_s=0.1)
    yield _row(video.count_frames, video=at / "a.mp4")
    yield _row(video.slot_bounds, num_frames=9, num_slots=4)
    yield _row(video.sharpness, bgr=rgb)


def _gaussians() -> Iterator[Row]:
    at, points, colors = folder(), np.random.default_rng(0).normal(size=(6, 3)), np.zeros((6, 3), np.uint8)
    for name in ("a.splat", "a.spz", "a.sog", "a.compressed.ply", "a.ply"):
        gaussian_files.write_gaussians(at / name, cloud())
        yield (
            f"write_gaussians to {name}",
            gaussian_files.write_gaussians,
            {"path": at / f"b{name}", "cloud": cloud()},
        )
        yield f"read_gaussians of {name}", gaussian_files.read_gaussians, {"path": at / name}
    yield _row(compressed_ply.write_compressed_ply, path=at / "b.compressed.ply", cloud=cloud())
    yield _row(compressed_ply.read_compressed_ply, path=at / "a.compressed.ply")
    yield _row(spz.write_spz, path=at / "b.spz", cloud=cloud())
    yield _row(spz.read_spz, path=at / "a.spz")
    yield _row(morton.morton_codes, points=points)
    yield _row(gaussian_ply.write_gaussian_ply, path=at / "b.ply", cloud=cloud())
    yield _row(gaussian_ply.read_gaussian_ply, path=at / "a.ply")
    yield _row(sog.write_sog, path=at / "b.sog", cloud=cloud())
    yield _row(sog.read_sog, path=at / "a.sog")
    voxel_files.write_grid(at / "grid.npz", grid())
    hash_files.write_hash(at / "hash.npz", neural())
    for kind, fixed in ((voxel_files.GridContents, grid()), (hash_files.HashContents, neural())):
        yield _row(kind, **{name: getattr(fixed, name) for name in fixed.__dataclass_fields__})
    yield _row(voxel_files.write_grid, path=at / "other.npz", grid=grid())
    yield _row(voxel_files.read_grid, path=at / "grid.npz")
    yield _row(hash_files.write_hash, path=at / "other.npz", field=neural())
    yield _row(hash_files.read_hash, path=at / "hash.npz")
    io.write_points_ply(at / "points.ply", points, colors)
    faces = np.array([[0, 1, 2], [1, 2, 3]])
    mesh_ply.write_mesh_ply(at / "mesh.ply", points, faces, colors)
    yield _row(io.write_points_ply, path=at / "b.ply", xyz=points, rgb=colors)
    yield _row(io.read_points_ply, path=at / "points.ply")
    yield _row(ply.vertex_type, xyz=points)
    yield _row(ply.ply_columns, path=at / "points.ply")
    yield _row(ply.frustum_segments, corners=np.zeros((2, 5, 3)))
    yield _row(mesh_ply.write_mesh_ply, path=at / "bmesh.ply", vertices=points, faces=faces, rgb=colors)
    yield _row(mesh_ply.read_mesh_ply, path=at / "mesh.ply")
    corners: dict[str, Any] = {"vertices_in_world": points, "faces": faces, "uv": np.full((2, 3, 2), 0.5)}
    corners |= {"texture_of_face": np.array([0, 1]), "textures": (np.zeros((4, 4, 3), np.uint8),) * 2}
    textured = TexturedMesh(**corners)
    gltf.write_glb(at / "mesh.glb", textured)
    yield _row(TexturedMesh, **corners)
    up = {"up": np.array([0.0, -1, 0]), "origin_in_world": np.ones(3)}
    yield _row(gltf.write_glb, path=at / "b.glb", mesh=textured, jpeg_quality=90, **up)
    yield _row(gltf.read_glb, path=at / "mesh.glb")
    yield _row(obj.write_obj, path=at / "b.obj", mesh=textured, jpeg_quality=90)
    yield _row(textured_ply.write_textured_ply, path=at / "textured.ply", mesh=textured, jpeg_quality=90)
    raster = rasters.Raster(np.ones((3, 4), np.float32), 500000.0, 5300000.0, 0.5, "EPSG:32632")
    rasters.write_geotiff(at / "dsm.tif", raster)
    fields = {name: getattr(raster, name) for name in rasters.Raster.__dataclass_fields__}
    yield _row(rasters.Raster, **fields)
    yield _row(rasters.write_geotiff, path=at / "bdsm.tif", raster=raster)
    yield _row(rasters.read_geotiff, path=at / "dsm.tif")
    known = {"crs": "EPSG:32632", "sigma": np.ones(6, np.float32), "classification": np.full(6, 2, np.uint8)}
    point_clouds.write_laz(at / "a.laz", points, colors, **known)
    yield _row(point_clouds.write_laz, path=at / "b.laz", points=points, rgb=colors, **known)
    chunks = [point_clouds.LazChunk(points, colors, known["sigma"])]
    bounds = np.stack([points.min(axis=0), points.max(axis=0)])
    yield _row(
        point_clouds.write_laz_chunks, path=at / "b.laz", chunks=chunks, bounds=bounds, crs="EPSG:32632"
    )
    yield _row(point_clouds.read_laz, path=at / "a.laz")
    bounds = np.column_stack([np.eye(3, 4), [12.0, 16.0, 15.0]])
    shutil.copytree(at / "left", at / "llff" / "images", dirs_exist_ok=True)
    np.save(at / "llff" / "poses_bounds.npy", np.tile(np.r_[bounds.ravel(), 1.0, 9.0], (2, 1)))
    yield _row(llff.read_llff, folder=at / "llff", max_side_px=16)


def _messages() -> Iterator[Row]:
    pose = Rigid3.exp(np.array([0.3, -2.0, 1.0, 0.4, -0.2, 0.9]))
    camera = Camera(CameraModel.PINHOLE, 64, 48, np.array([50.0, 50.0, 31.5, 23.5]))
    yield _row(ros.header_fields, stamp_s=12.5, frame="world")
    yield _row(ros.transform_fields, stamp_s=12.5, parent_from_child=pose, parent="world", child="body")
    named = {"stamp_s": 12.5, "world": "world", "body": "body"}
    yield _row(ros.odometry_fields, world_from_body=pose, covariance=np.eye(6), **named)
    stamps, poses = np.array([1.0, 2.0]), Rigid3.identity(2)
    yield _row(ros.path_fields, stamps_s=stamps, world_from_body=poses, world="world", stamp_s=12.5)
    yield _row(ros.points_fields, stamp_s=12.5, xyz=np.ones((4, 3)), frame="world")
    yield _row(ros.jpeg_fields, stamp_s=12.5, image=np.zeros((6, 8), np.uint8), frame="camera", quality=90)
    yield _row(ros.camera_info_fields, stamp_s=12.5, camera=camera, frame="camera")
    yield _row(bag_writing.require_writing, path=folder() / "run.mcap")


def _names() -> Iterator[Row]:
    yield _row(picture_names.name_problem, name="a.png")
    yield _row(picture_names.printable, name="a.png")
    yield _row(picture_names.fits, name="a.png", pattern="*.png")
    yield _row(picture_names.depth_among, names=["a.png", "b.png"], deep_gray=frozenset({"a.png"}))


FOLDERS_ALONE = {"atomic_folder", "atomic_write"}
"""Context managers, which are called by writers."""
RESULTS = {"G2oFile", "ImageSequence", "PlyPoints", "TruthCameras"}
"""What readers return."""
