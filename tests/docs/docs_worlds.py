"""The files that the command lines of each page speak of: small, and of the kind that the page says."""

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import docs_ride
import numpy as np
from docs_ride import LENS
from docs_setups import PREPARED, photographs

import epipole
from board_pictures import board_pictures
from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.io import write_trajectory
from epipole.io.calibration.files import (
    CalibrationFile,
    read_calibration,
    write_calibration,
    write_opencv_yaml,
)
from epipole.io.colmap.model import read_colmap_model
from epipole.io.images.photographs import write_jpeg_with_exif
from epipole.io.meshes.ply import write_points_ply
from epipole.scene import Trajectory
from epipole.synthetic import courtyard, courtyard_views, render

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "fields"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "io"))
from fields_scenes import CAMERA, camera, frames_of, views
from test_io_llff import write_scene
from test_sfm_rigs import write_pair_photographs

from io_models import write_gcp_list

LARGE = Camera("PINHOLE", 1536, 1024, [1380.0, 1380.0, 767.5, 511.5])


def calibration_of(camera: Camera) -> CalibrationFile:
    return CalibrationFile((camera,), Rigid3(np.eye(3)[None], np.zeros((1, 3))))


def large_photographs(folder: Path) -> None:
    """IMAGES of 1536 x 1024 by a lens of 1380 pixels, MASKS and CAL."""
    small = Camera("PINHOLE", 480, 320, [431.25, 431.25, 239.5, 159.5])
    (folder / "IMAGES").mkdir()
    (folder / "MASKS").mkdir()
    views = courtyard_views(24)[np.arange(6, 9)]
    for n in range(3):
        rendered = render(courtyard(), small, views[n], noise_sigma=1.5, seed=n)
        image = cv2.resize(rendered.rgb, (LARGE.width, LARGE.height), interpolation=cv2.INTER_CUBIC)
        name = f"view_{n}.color.jpg"
        write_jpeg_with_exif(folder / "IMAGES" / name, image, focal_35mm=1380 / 1536 * 36)
        mask = np.full((LARGE.height, LARGE.width), 255, np.uint8)
        mask[:40] = 0
        cv2.imwrite(str(folder / "MASKS" / f"{name}.png"), mask)
    (folder / "CAL").mkdir()
    write_calibration(folder / "CAL" / "calibration.json", calibration_of(LARGE))


def from_colmap(folder: Path) -> None:
    """IMAGES, and a database of their features and matches."""
    large_photographs(folder)
    epipole.reconstruct(folder / "IMAGES", folder / "before", max_size_px=480)
    shutil.copy(folder / "before" / "database.db", folder)


def results(folder: Path) -> None:
    """What a reconstruction left has a second model; a cloud, and two paths."""
    shutil.copytree(folder / "OUT" / "sparse" / "0", folder / "OUT" / "sparse" / "1", dirs_exist_ok=True)
    rng = np.random.default_rng(0)
    write_points_ply(
        folder / "cloud.ply", rng.normal(size=(200, 3)), rng.integers(0, 256, (200, 3)).astype(np.uint8)
    )
    path = Trajectory(0.1 * np.arange(12), Rigid3.exp(0.1 * np.arange(72.0).reshape(12, 6) / 12))
    for name in ("PATH.txt", "TRUTH.txt"):
        write_trajectory(path, folder / name, "tum")


def walk(folder: Path) -> None:
    photographs(folder)
    docs_ride.short_video(folder / "walk.mp4")


def pair(folder: Path) -> None:
    """A rectified pair, LEFT and RIGHT, its calibration in two forms, and BOARDS before two cameras."""
    PREPARED["stereo"](folder)
    shutil.copy(folder / "calibration.json", folder / "FILE")
    write_opencv_yaml(folder / "stereo.yaml", read_calibration(folder / "FILE"))
    for side, moved_m in (("left", 0.0), ("right", -0.03)):
        board_pictures(folder / side, moved_m=moved_m)
        (folder / "BOARDS" / side).mkdir(parents=True)
        for path in sorted((folder / side / "IMAGES").iterdir()):
            half = cv2.resize(cv2.imread(str(path)), (320, 240), interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(folder / "BOARDS" / side / path.name), half)


def boards(folder: Path) -> None:
    board_pictures(folder)


def known_ride(folder: Path) -> None:
    """SOURCE, a pair's ride; FRAMES and TUESDAY of one camera, FILE, its calibration; WHEELS and TRUTH.txt."""
    docs_ride.kitti(folder / "SOURCE")
    for name in ("FRAMES", "TUESDAY"):
        docs_ride.images(folder / name)
    write_calibration(folder / "FILE", calibration_of(LENS))
    docs_ride.wheels(folder / "WHEELS")
    write_trajectory(docs_ride.ride().path(), folder / "TRUTH.txt")


def sources_of_slam(folder: Path) -> None:
    docs_ride.recording(folder, "ros1")
    docs_ride.recording(folder, "mcap", "recording")
    docs_ride.kitti(folder / "ride")
    docs_ride.video(folder / "ride.mp4")
    write_opencv_yaml(folder / "camera.yaml", calibration_of(LENS))
    names = docs_ride.many_pictures(folder / "frames", 100)
    (folder / "masks").mkdir()
    for name in names:
        cv2.imwrite(str(folder / "masks" / f"{name}.png"), np.full((LENS.height, LENS.width), 255, np.uint8))


def stopped_ride(folder: Path) -> None:
    docs_ride.kitti(folder / "SOURCE")
    write_trajectory(docs_ride.ride().path(hz=docs_ride.KITTI_HZ), folder / "groundtruth.txt")


def meters_for_slam(folder: Path) -> None:
    docs_ride.video(folder / "ride.mp4")
    docs_ride.images(folder / "ride")
    docs_ride.euroc(folder / "flight")
    meters(folder)
    docs_ride.positions(folder / "gps.txt")


def ride_with_imu(folder: Path) -> None:
    docs_ride.tum(folder / "ride")
    docs_ride.imu(folder / "ride")


def rig_ride(folder: Path) -> None:
    docs_ride.rig(folder / "ride", folder / "camchain.yaml")


def meters(folder: Path) -> None:
    docs_ride.wheels(folder / "wheels.txt")
    docs_ride.mounting(folder / "mount.yaml")


def meters_for_photographs(folder: Path) -> None:
    names = docs_ride.images(folder / "photos", docs_ride.FEW)
    docs_ride.positions(folder / "places.txt", names, docs_ride.FEW)
    docs_ride.lengths(folder / "lengths.txt", names, docs_ride.FEW)
    docs_ride.short_video(folder / "walk.mp4")
    docs_ride.euroc(folder / "flight")
    meters(folder)


def maps(folder: Path) -> None:
    for name in ("monday", "tuesday"):
        docs_ride.kitti(folder / name)


def from_orb_slam(folder: Path) -> None:
    for name in ("rgbd_dataset_freiburg1_xyz", "rgbd_dataset_freiburg1_desk"):
        docs_ride.tum(folder / name)
    docs_ride.images(folder / "frames")


def field_sources(*names: str, model: str | None = None) -> Callable[[Path], None]:
    """PHOTOS of the ride, an output of a reconstruction, and images with cameras as NeRF writes them."""

    def prepare(folder: Path) -> None:
        docs_ride.images(folder / "PHOTOS", docs_ride.FEW, ".jpg", is_half=True)
        if model is not None:
            PREPARED["fields"](folder)
            (folder / "MODEL").rename(folder / model)
        for name in names:
            scene(folder / name)

    return prepare


def scene(folder: Path) -> None:
    folder.mkdir()
    (folder / "transforms.json").write_text(json.dumps(camera() | {"frames": frames_of(views(), folder)}))


def fields_of_all_kinds(folder: Path) -> None:
    """NeRF's and LLFF's layouts beside a model and photographs."""
    field_sources("scene", model="OUT2")(folder)
    (folder / "PHOTOS").rename(folder / "photos")
    shutil.copy(folder / "scene" / "transforms.json", folder)
    (folder / "lego").mkdir()
    angle, frames = 2 * np.arctan(0.5 * CAMERA.width / CAMERA.params[0]), frames_of(views(), folder / "lego")
    for name, own in (("train", frames[:10]), ("test", frames[10:])):
        content = json.dumps({"camera_angle_x": angle, "frames": own})
        (folder / "lego" / f"transforms_{name}.json").write_text(content)
    write_scene(folder / "fern", 6)


def splats(folder: Path) -> None:
    scene(folder / "SCENE")
    epipole.splat(folder / "SCENE", folder / "PATH", steps=20, max_gaussians=500)


def trained_splats(folder: Path) -> None:
    """The same in OUT, beside a transforms.json."""
    splats(folder)
    (folder / "PATH").rename(folder / "OUT")
    shutil.copy(folder / "SCENE" / "transforms.json", folder)


def tour_photographs(folder: Path, width: int = 480) -> None:
    """Six neighboring photographs of the demo, with its names and its camera, at half its size."""
    f, height = 28 / 36 * width, 2 * width // 3
    camera = Camera("SIMPLE_RADIAL", width, height, [f, (width - 1) / 2, (height - 1) / 2, -0.05])
    views = courtyard_views(24)
    at = folder / "demo" / "photographs"
    at.mkdir(parents=True)
    for n in range(2, 8):
        image = render(courtyard(), camera, views[n], noise_sigma=1.5, seed=n).rgb
        write_jpeg_with_exif(at / f"courtyard_{n + 1:03d}.jpg", image, focal_35mm=28.0)


def tour_model(folder: Path, width: int = 480) -> None:
    """These and their reconstruction, which the pages of the tour have in common."""
    if not (folder / "tour" / "model").exists():
        tour_photographs(folder, width)
        epipole.reconstruct(folder / "demo" / "photographs", folder / "tour" / "model", max_size_px=480)


def tour_splats(folder: Path) -> None:
    """The same, and a short training."""
    tour_model(folder)
    if not (folder / "tour" / "splats").exists():
        epipole.splat(folder / "tour" / "model", folder / "tour" / "splats", steps=20, max_gaussians=2000)


def tour_ride(folder: Path) -> None:
    """The same at the size for which the page gives the intrinsics."""
    tour_model(folder, 960)


def tour_untrained(folder: Path) -> None:
    tour_model(folder)
    shutil.rmtree(folder / "tour" / "splats", ignore_errors=True)


def nothing(_: Path) -> None:
    """The lines name no file."""


def new_photographs(folder: Path) -> None:
    """Two of the photographs, under other names."""
    (folder / "NEW").mkdir(exist_ok=True)
    for name, path in zip(("photo.jpg", "other.jpg"), sorted((folder / "IMAGES").iterdir())):
        shutil.copy2(path, folder / "NEW" / name)


def two_models(folder: Path) -> None:
    """The reconstruction twice."""
    for name in ("OUT1", "OUT2"):
        shutil.copytree(folder / "OUT", folder / name, dirs_exist_ok=True)


def pair_with_rig(folder: Path) -> None:
    """Photographs of two cameras, and their rig."""
    write_pair_photographs(folder / "IMAGES", folder / "rig.json")


def surveyed(folder: Path) -> None:
    """Control points on the reconstruction."""
    write_gcp_list(folder / "gcp_list.txt", read_colmap_model(folder / "OUT" / "sparse" / "0"))


def new_and_surveyed(folder: Path) -> None:
    new_photographs(folder)
    surveyed(folder)


def no_cloud(folder: Path) -> None:
    """No cloud of another program."""
    (folder / "cloud.ply").unlink(missing_ok=True)


AFTER_RECONSTRUCTING: dict[str, Callable[[Path], None]] = {
    "README-0": new_and_surveyed,
    "command_line-1": results,
    "first_model-0": nothing,
    "first_model-1": nothing,
    "first_model-2": no_cloud,
    "index-0": nothing,
    "georeferencing-0": surveyed,
    "localization-0": new_photographs,
    "surfaces-0": nothing,
    "visual_effects-0": nothing,
    "survey-0": surveyed,
    "merging-0": nothing,
    "merging-1": two_models,
    "reconstruction-1": nothing,
    "tour/4_depth-0": tour_model,
    "tour/6_splats-0": tour_untrained,
    "tour/7_mesh-0": tour_splats,
    "tour/8_share-0": tour_splats,
}
"""By the page and the number of its block: where IMAGES are six photographs, OUT their reconstruction and DIR the true cameras."""
WORLDS: dict[str, Callable[[Path], None]] = {
    "README-1": pair,
    "README-2": known_ride,
    "README-3": field_sources(),
    "README-4": nothing,
    "cluster-0": walk,
    "command_line-0": nothing,
    "calibration-0": boards,
    "calibration-1": pair,
    "coming_from/colmap-0": from_colmap,
    "coming_from/nerfstudio-0": field_sources("SCENE"),
    "coming_from/nerfstudio-1": field_sources(),
    "coming_from/opencv-0": pair,
    "coming_from/orb_slam3-0": from_orb_slam,
    "fields-0": fields_of_all_kinds,
    "fields-1": trained_splats,
    "install-0": nothing,
    "install-1": nothing,
    "install-2": nothing,
    "reconstruction-0": walk,
    "rigs-0": pair_with_rig,
    "scale-0": meters_for_photographs,
    "slam-0": stopped_ride,
    "slam-1": meters_for_slam,
    "slam_imu-0": ride_with_imu,
    "slam_maps-0": maps,
    "slam_maps-1": stopped_ride,
    "slam_rigs-0": rig_ride,
    "slam_ros-0": stopped_ride,
    "slam_sources-0": sources_of_slam,
    "stereo-0": pair,
    "tour/1_photographs-0": nothing,
    "tour/2_cameras-0": tour_photographs,
    "tour/5_trajectory-0": tour_ride,
    "viewer-0": splats,
}
"""The same in an empty folder."""
