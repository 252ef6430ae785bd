"""What the pages' code speaks of: small files in a folder, and arrays."""

import bz2
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from board_pictures import board_pictures
from epipole.cameras import Camera
from epipole.geometry import Rigid3, Rotation3
from epipole.inertial import ImuLog
from epipole.io import read_colmap_model, write_colmap_model, write_g2o
from epipole.io.calibration.files import CalibrationFile, write_calibration
from epipole.optim import PoseGraph
from epipole.pipelines.slam.frames import DepthCamera, Frame, SlamCamera
from epipole.pipelines.slam.output.map_file import write_slam_map
from epipole.pipelines.slam.slam import Slam
from epipole.synthetic import courtyard, look_at, render
from epipole.synthetic.problems import absolute_pose_problem, bundle_problem, two_view_problem
from epipole.synthetic.stereo_rooms import stereo_room
from io_models import write_gcp_list

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "sfm"))
from photographs import neighboring_views, render_to

SIZE = (320, 240)


def two_views() -> dict[str, Any]:
    problem = two_view_problem(300, outlier_ratio=0.2, noise_px=0.5)
    return {name: getattr(problem, name) for name in ("pixels1", "pixels2", "camera1", "camera2")}


def photographs(folder: Path) -> dict[str, Any]:
    """IMAGES, and as DIR Strecha's known cameras."""
    views = neighboring_views(6)
    (folder / "DIR").mkdir()
    for name, view in zip(render_to(folder / "IMAGES", views), views):
        rows = [*np.eye(3), np.zeros(3), *view.rotation.T, view.centers()]
        lines = [" ".join(map(str, row)) for row in rows]
        (folder / "DIR" / f"{name}.camera").write_text("\n".join([*lines, "480 320"]))
    return two_views()


def cameras(folder: Path) -> dict[str, Any]:
    model(folder)
    calibration(folder)
    return {"image": np.zeros((480, 640, 3), np.uint8)}


def calibration(folder: Path) -> None:
    camera = Camera("PINHOLE", *SIZE, [300, 300, 159.5, 119.5])
    motions = Rigid3(np.stack([np.eye(3)] * 2), np.array([[0.0, 0, 0], [-0.12, 0.001, 0]]))
    write_calibration(
        folder / "calibration.json", CalibrationFile((camera, camera), motions, 1e-8 * np.eye(30))
    )


def model(folder: Path) -> None:
    write_colmap_model(bundle_problem(6, 100, 4).truth, folder / "OUT" / "sparse" / "0")


def seen_model(folder: Path) -> dict[str, Any]:
    """A model with its images, which are of one color."""
    truth = bundle_problem(6, 100, 4).truth
    write_colmap_model(truth, folder / "MODEL" / "sparse" / "0")
    for row, name in enumerate(truth.images.name):
        camera = truth.cameras[int(truth.camera_of_image[row])]
        path = folder / "MODEL" / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (camera.width, camera.height), (200, 150, 90)).save(path)
    return {}


def toured_model(folder: Path) -> dict[str, Any]:
    write_colmap_model(bundle_problem(6, 100, 4).truth, folder / "tour" / "model" / "sparse" / "0")
    return {}


def bundle(folder: Path) -> dict[str, Any]:
    """A file of Bundle Adjustment in the Large: cameras look along -z."""
    rng = np.random.default_rng(2)
    points = rng.uniform([-2, -2, -9], [2, 2, -6], (60, 3))
    positions = np.column_stack([rng.normal(0, 0.02, (4, 3)), 0.5 * np.arange(4), np.zeros((4, 2))])
    seen = []
    for k, position in enumerate(positions):
        in_cam = points @ Rotation3.exp(position[:3]).matrix.T + position[3:]
        pixels = -500 * in_cam[:, :2] / in_cam[:, 2:] + rng.normal(0, 0.3, (60, 2))
        seen += [f"{k} {j} {x} {y}" for j, (x, y) in enumerate(pixels)]
    values = np.concatenate([*(np.r_[position, 500, 0, 0] for position in positions), points.ravel()])
    text = "\n".join([f"4 60 {len(seen)}", *seen, *map(str, values)])
    packed = bz2.compress(text.encode())
    (folder / "problem-16-22106-pre.txt.bz2").write_bytes(packed)
    model(folder)
    return {}


def pose_graph(folder: Path) -> dict[str, Any]:
    step = Rigid3.exp(np.tile([1.0, 0, 0, 0, 0, 2 * np.pi / 8], (8, 1)))
    first = np.arange(8)
    start = Rigid3.exp(np.random.default_rng(0).normal(0, 0.1, (8, 6)))
    graph = PoseGraph(start, first, (first + 1) % 8, step, np.tile(np.eye(6), (8, 1, 1)))
    write_g2o(folder / "sphere2500.g2o", graph)
    return {}


def stereo_pair(folder: Path) -> dict[str, Any]:
    pair = stereo_room(8, SIZE)
    for name in ("left", "right"):
        Image.fromarray(getattr(pair, name)).save(folder / name.upper(), format="PNG")
    calibration(folder)
    return {"left": pair.left, "right": pair.right}


def ride(_: Path) -> dict[str, Any]:
    """A depth camera that moves sideways before the courtyard."""
    camera = Camera("PINHOLE", *SIZE, [0.8 * SIZE[0], 0.8 * SIZE[0], (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2])
    positions = [look_at((0.03 * n, -4.0, 1.4), (0.03 * n, 0.4, 0.6)) for n in range(4)]
    seen = [render(courtyard(), camera, position) for position in positions]
    grays = [cv2.cvtColor(image.rgb, cv2.COLOR_RGB2GRAY) for image in seen]
    depths = [np.nan_to_num(image.depth, nan=0.0).astype(np.float32) for image in seen]
    log = ImuLog(0.005 * np.arange(100), np.zeros((100, 3)), np.tile([0.0, -9.81, 0.0], (100, 1)))
    return {
        "camera": camera,
        "images": [(0.1 * n, *both) for n, both in enumerate(zip(grays, depths))],
        "camera_from_imu": Rigid3.identity(),
        **{"times_s": log.timestamp_s, "gyro_rad_s": log.gyro_rad_s, "accel_m_s2": log.accel_m_s2},
    }


def moving_depth_camera(folder: Path) -> dict[str, Any]:
    """The same, as the camera of SLAM and its first frame."""
    given = ride(folder)
    seconds, gray, depth = given["images"][0]
    sensor = DepthCamera(given["camera"], Rigid3.identity())
    frame = {"seconds": seconds, "gray": gray, "depth": depth}
    return given | frame | {"slam_camera": SlamCamera(given["camera"], depth=sensor)}


def rig_instants(_: Path) -> dict[str, Any]:
    """Two parallel cameras that move sideways before the courtyard."""
    given = ride(_)
    camera, poses = (
        given["camera"],
        Rigid3(np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0] * 3, [-0.12, 0, 0]])),
    )
    instants = []
    for n in range(4):
        first = look_at((0.03 * n, -4.0, 1.4), (0.03 * n, 0.4, 0.6))
        instants.append((0.1 * n, [render(courtyard(), camera, poses[k] @ first).rgb for k in range(2)]))
    return {"camera": camera, "poses": poses, "instants": instants}


def ride_folder(folder: Path, count: int) -> None:
    """The same in the form of KITTI: pairs of gray images and calib.txt."""
    camera = Camera("PINHOLE", *SIZE, [260.0, 260.0, 159.5, 119.5])
    for side, offset in (("image_0", 0.0), ("image_1", 0.12)):
        (folder / side).mkdir(parents=True)
        for n in range(count):
            at = np.array([0.03 * n + offset, -4.0, 1.4])
            image = render(courtyard(), camera, look_at(at, at + np.array([0.0, 4.4, -0.8])))
            gray = cv2.cvtColor(image.rgb, cv2.COLOR_RGB2GRAY)
            cv2.imwrite(str(folder / side / f"{n:06d}.png"), gray)
    rows = [[260, 0, 159.5, x, 0, 260, 119.5, 0, 0, 0, 1, 0] for x in (0.0, -260 * 0.12)]
    text = "".join(f"P{k}: {' '.join(map(str, row))}\n" for k, row in enumerate(rows))
    (folder / "calib.txt").write_text(text)


def pair_ride(folder: Path) -> dict[str, Any]:
    ride_folder(folder / "SOURCE", 4)
    return {}


def mapped_ride(folder: Path) -> dict[str, Any]:
    """The ride of the depth camera, and its map in OUT."""
    names = moving_depth_camera(folder)
    slam = Slam(names["slam_camera"])
    for seconds, gray, depth in names["images"]:
        slam.track(Frame(seconds, gray, depth=depth))
    (folder / "OUT" / "map").mkdir(parents=True)
    keyframes = [str(keyframe.number) for keyframe in slam.maps[0].keyframes]
    write_slam_map(folder / "OUT" / "map" / "map.npz", slam.maps[0], keyframes, names["slam_camera"])
    return names


def known_points(_: Path) -> dict[str, Any]:
    problem = absolute_pose_problem(100, outlier_ratio=0.2, noise_px=0.5)
    return {name: getattr(problem, name) for name in ("points_in_world", "pixels", "camera")}


def tracks(_: Path) -> dict[str, Any]:
    truth = bundle_problem(5, 80, 5).truth
    motions = truth.cams_from_world()
    pixels = [truth.cameras[0].project(motion.apply(truth.points.xyz_in_world)) for motion in motions]
    return {"cams_from_world": motions, "camera": truth.cameras[0], "pixels": np.stack(pixels)}


def ten_tasks() -> dict[str, Any]:
    """Arrays with known answers: a distorted camera, two views of points and of a plane, a rectified pair, tracks."""
    K, size, rng = (
        np.array([[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1.0]]),
        (640, 480),
        np.random.default_rng(3),
    )
    dist = np.array([-0.1, 0.02, 0.0005, -0.0004])
    camera = Camera.from_K(K, size, dist)
    motion = Rigid3(Rotation3.exp(np.array([0.02, 0.1, -0.01])).matrix, np.array([-0.8, 0.02, 0.1]))
    X = rng.uniform([-1.8, -1.2, 4.0], [1.8, 1.2, 8.0], (200, 3))
    x1, x2 = camera.project(X), camera.project(motion.apply(X))
    flat = X * (5.0 / X[:, 2:])
    pinhole = Camera.from_K(K, size)
    pair = stereo_room(8, SIZE)
    image, point = (each.ravel() for each in np.meshgrid([0, 1], np.arange(len(X))))
    return {
        **{
            "K": K,
            "dist": dist,
            "size": size,
            "X": X,
            "x1": x1,
            "x2": x2,
            "R": motion.rotation,
            "t": motion.translation,
        },
        **{"p1": pinhole.project(X), "p2": pinhole.project(motion.apply(X))},
        **{"flat1": pinhole.project(flat), "flat2": pinhole.project(motion.apply(flat))},
        **{
            "left": pair.left,
            "right": pair.right,
            "focal_px": pair.camera.focal_px,
            "baseline": pair.baseline,
        },
        **{"image": image, "point": point, "pixels": np.stack([x1, x2], axis=1).reshape(-1, 2)},
    }


def usual(folder: Path, reconstructed: Path) -> dict[str, Any]:
    """For pages without a setup of their own: a reconstruction of IMAGES in OUT, and arrays of two views and of known points."""
    shutil.copytree(reconstructed, folder, dirs_exist_ok=True)
    calibration(folder)
    write_gcp_list(folder / "gcp_list.txt", read_colmap_model(folder / "OUT" / "sparse" / "0"))
    image = np.asarray(Image.open(sorted((folder / "IMAGES").iterdir())[0]))
    return {"image": image, **known_points(folder), **two_views(), **ten_tasks()}


PREPARED: dict[str, Callable[[Path], dict[str, Any]]] = {
    "absolute_pose": known_points,
    "bundle_adjustment": bundle,
    "calibration": board_pictures,
    "cameras": cameras,
    "conventions": lambda _: {},
    "fields": seen_model,
    "fundamental_matrix": lambda _: two_views(),
    "homography": lambda _: two_views(),
    "pairs": lambda _: two_views(),
    "pose_graphs": pose_graph,
    "relative_pose": lambda _: two_views(),
    "slam": pair_ride,
    "slam_imu": moving_depth_camera,
    "slam_live": ride,
    "slam_maps": mapped_ride,
    "slam_rigs": rig_instants,
    "scale": lambda _: {},
    "stereo": stereo_pair,
    "tour/3_points": toured_model,
    "triangulation": tracks,
}
"""By the page's path below docs/ without .md: makes its files in a folder and returns its names."""
IN_PLACE = ("README", "first_model", "command_line")
"""Pages that reconstruct IMAGES into OUT: they run where that has been done, and go on from there."""
