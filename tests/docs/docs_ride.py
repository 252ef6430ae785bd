"""A ride before a courtyard with two tags and a board in it, as files of each kind that the command lines of the pages name."""

import json
import shutil
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import cv2
import numpy as np
import yaml

from bag_writing import Recorded
from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.io import write_trajectory
from epipole.io.images.depth_maps import write_png16
from epipole.io.images.video_files import write_video
from epipole.scene import Trajectory
from epipole.synthetic import SyntheticScene, courtyard, look_at, render
from epipole.synthetic.inertial import imu_along
from epipole.synthetic.markers import chessboard_sheet, tag_sheet

LENS = Camera("PINHOLE", 640, 480, [500.0, 500.0, 319.5, 239.5])
"""`--camera-params 500,500,320,240`."""
COUNT, HZ, KITTI_HZ, BASELINE = 18, 30.0, 10.0, 0.12
PAIRS = 8
"""How many of the first frames have a right image."""
FEW = slice(1, None, 3)
"""Frames that are taken as photographs."""
RIGHT_FROM_LEFT = Rigid3(np.eye(3), np.array([-BASELINE, 0.0, 0.0]))


class Ride(NamedTuple):
    """What the sensors saw, and from where."""

    left: list[np.ndarray]
    """(h, w, 3) RGB."""
    right: list[np.ndarray]
    """Of the first PAIRS frames."""
    depth: list[np.ndarray]
    """(h, w) meters, 0 where there is none."""
    cams_from_world: Rigid3

    def path(self, hz: float = HZ) -> Trajectory:
        """world_from_camera at the frames' times, the first of which is 0."""
        return Trajectory(np.arange(COUNT) / hz, self.cams_from_world.inverse())


@cache
def ride() -> Ride:
    """Along an arc, rendered once."""
    angles = np.deg2rad(-75.0 + 1.5 * np.arange(COUNT))
    centers = np.column_stack(
        [4.4 * np.cos(angles), 4.4 * np.sin(angles), 1.4 + 0.02 * np.sin(np.arange(COUNT))]
    )
    positions = [look_at(center, (-0.2, 0.4, 0.6)) for center in centers]
    scene = _scene(float(angles[COUNT // 2]))
    left = [render(scene, LENS, position) for position in positions]
    right = [render(scene, LENS, RIGHT_FROM_LEFT @ position).rgb for position in positions[:PAIRS]]
    depth = [np.nan_to_num(image.depth, nan=0.0).astype(np.float32) for image in left]
    together = Rigid3(np.stack([p.rotation for p in positions]), np.stack([p.translation for p in positions]))
    return Ride([image.rgb for image in left], right, depth, together)


def _scene(angle: float) -> SyntheticScene:
    """The courtyard; 1.2 m before the middle of the ride two tags of 12 cm, and a board of 9 x 6 corners, 3 cm apart."""
    ahead = -np.array([np.cos(angle), np.sin(angle), 0.0])
    aside = np.array([ahead[1], -ahead[0], 0.0])
    axes = tuple(aside), (0.0, 0.0, -1.0)

    def at(meters: float) -> tuple[float, ...]:
        return tuple(-3.2 * ahead + meters * aside + np.array([0.0, 0.0, 1.05]))

    sheets = [
        *tag_sheet(1, 0.12, at(-0.4), *axes),
        *tag_sheet(2, 0.12, at(0.4), *axes),
        *chessboard_sheet(9, 6, 0.03, at(0.0), *axes),
    ]
    yard, things = courtyard(), SyntheticScene.of(sheets)
    columns = ("kind", "params", "texture", "color", "seed")
    both = {name: np.concatenate([getattr(yard, name), getattr(things, name)]) for name in columns}
    return SyntheticScene(**both, light=yard.light)


def gray(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def images(
    folder: Path, numbers: slice = slice(None), ending: str = ".png", is_half: bool = False
) -> list[str]:
    """A folder of images, of half the width and height if asked for; their names."""
    folder.mkdir(parents=True)
    names = []
    for n, image in enumerate(ride().left[numbers]):
        names.append(f"{n:03d}{ending}")
        cv2.imwrite(str(folder / names[-1]), (half(image) if is_half else image)[..., ::-1])
    return names


def half(image: np.ndarray) -> np.ndarray:
    """Of half the width and height."""
    return cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def many_pictures(folder: Path, at_rest: int) -> list[str]:
    """The ride after so many images at rest, two of each frame."""
    names = images(folder)
    for name in names:
        (folder / name).rename(folder / f"frame_{name}")
    out = []
    for n in range(at_rest + 2 * COUNT):
        out.append(f"{n:06d}.png")
        shutil.copy(folder / f"frame_{names[max(n - at_rest, 0) // 2]}", folder / out[-1])
    for name in names:
        (folder / f"frame_{name}").unlink()
    return out


def lengths(path: Path, names: list[str], numbers: slice) -> None:
    """Two points of the wall, in three images."""
    ends = np.array([[-0.6, 2.4, 1.0], [0.5, 2.4, 1.2]])
    lines = []
    for end, position in zip("ab", ends):
        for n in (0, 2, 4):
            view = ride().cams_from_world[int(np.arange(COUNT)[numbers][n])]
            x, y = LENS.project(view.apply(position[None]))[0]
            lines.append(f"wall {np.linalg.norm(ends[0] - ends[1])} {end} {names[n]} {x} {y}\n")
    path.write_text("".join(lines))


def video(path: Path) -> None:
    path.write_bytes(_encoded(False))


def short_video(path: Path) -> None:
    """Every third frame, small."""
    path.write_bytes(_encoded(True))


@cache
def _encoded(is_short: bool) -> bytes:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.mp4"
        if is_short:
            write_video(path, [half(image) for image in ride().left[::3]], HZ / 3)
        else:
            write_video(path, ride().left, HZ)
        return path.read_bytes()


def kitti(folder: Path) -> None:
    for name, seen in (("image_0", ride().left[:PAIRS]), ("image_1", ride().right)):
        (folder / name).mkdir(parents=True)
        for n, image in enumerate(seen):
            cv2.imwrite(str(folder / name / f"{n:06d}.png"), gray(image))
    f, _, cx, cy = LENS.params
    rows = [[f, 0, cx, x, 0, f, cy, 0, 0, 0, 1, 0] for x in (0.0, -f * BASELINE)]
    lines = [f"P{k}: {' '.join(map(str, row))}\n" for k, row in enumerate(rows)]
    (folder / "calib.txt").write_text("".join(lines))


def rig(folder: Path, calibration: Path) -> None:
    """The pairs as the images of a rig, with Kalibr's calibration."""
    chain = {}
    for name, seen in (("cam0", ride().left[:PAIRS]), ("cam1", ride().right)):
        (folder / name).mkdir(parents=True)
        for n, image in enumerate(seen):
            cv2.imwrite(str(folder / name / f"{n:06d}.png"), gray(image))
        f, _, cx, cy = LENS.params.tolist()
        size = [LENS.width, LENS.height]
        chain[name] = {"camera_model": "pinhole", "intrinsics": [f, f, cx, cy], "resolution": size}
        chain[name] |= {"distortion_model": "radtan", "distortion_coeffs": [0.0, 0.0, 0.0, 0.0]}
    matrix = np.eye(4)
    matrix[0, 3] = -BASELINE
    chain["cam1"]["T_cn_cnm1"] = matrix.tolist()
    calibration.write_text(yaml.safe_dump(chain))


def tum(folder: Path) -> None:
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for n, (image, depth) in enumerate(zip(ride().left, ride().depth)):
        cv2.imwrite(str(folder / "rgb" / f"{n}.png"), image[..., ::-1])
        write_png16(folder / "depth" / f"{n}.png", depth, 5000.0)
    for name in ("rgb", "depth"):
        (folder / f"{name}.txt").write_text("".join(f"{n / HZ:.6f} {name}/{n}.png\n" for n in range(COUNT)))
    write_trajectory(ride().path(), folder / "groundtruth.txt")


def euroc(folder: Path) -> None:
    """One camera with an inertial unit."""
    camera, unit = folder / "mav0" / "cam0", folder / "mav0" / "imu0"
    images(camera / "data")
    unit.mkdir(parents=True)
    names = [f"{n:03d}.png" for n in range(COUNT)]
    first = 1_400_000_000_000_000_000
    rows = [f"{first + round(1e9 * n / HZ)},{name}\n" for n, name in enumerate(names)]
    (camera / "data.csv").write_text("#timestamp [ns],filename\n" + "".join(rows))
    given = {
        "T_BS": {"rows": 4, "cols": 4, "data": np.eye(4).ravel().tolist()},
        **{"rate_hz": HZ, "resolution": [LENS.width, LENS.height], "camera_model": "pinhole"},
        **{"intrinsics": LENS.params.tolist(), "distortion_model": "radial-tangential"},
        "distortion_coefficients": [0.0] * 4,
    }
    (camera / "sensor.yaml").write_text(json.dumps(given))
    log = imu_along(ride().path().timestamp_s, ride().path().world_from_body, Rigid3.identity(), 0)
    times = first + np.rint(1e9 * log.timestamp_s).astype(np.int64)
    values = np.column_stack([log.gyro_rad_s, log.accel_m_s2])
    rows = [f"{time},{','.join(map(str, row))}\n" for time, row in zip(times, values)]
    (unit / "data.csv").write_text("#timestamp [ns],w x,y,z,a x,y,z\n" + "".join(rows))


def imu(folder: Path) -> None:
    """A table of measurements, and a file of the mounting."""
    log = imu_along(ride().path().timestamp_s, ride().path().world_from_body, Rigid3.identity(), 0)
    np.savetxt(folder / "imu.txt", np.column_stack([log.timestamp_s, log.gyro_rad_s, log.accel_m_s2]))
    (folder / "mounting.yaml").write_text(f"T_cam_imu: {np.eye(4).tolist()}\n")


def recording(folder: Path, kind: str, name: str = "ride") -> Path:
    """Of ROS: NAME.bag, or the folder NAME, of a pair of cameras."""
    out, size = Recorded(kind), (LENS.width, LENS.height)
    for n in range(PAIRS):
        ns = 1_500_000_000 * 10**9 + round(1e9 * n / HZ)
        for side, seen, corner in (("left", ride().left, 0.0), ("right", ride().right, -500.0 * BASELINE)):
            P = np.column_stack([LENS.K, [corner, 0, 0]])
            out.image(f"/{side}/image_raw", ns, gray(seen[n]), "mono8")
            out.camera_info(f"/{side}/camera_info", ns, size, LENS.K, P=P)
    return out.write(folder, name)


def wheels(path: Path) -> None:
    """SECONDS METERS a line."""
    steps = np.linalg.norm(np.diff(ride().cams_from_world.centers(), axis=0), axis=1)
    meters = np.concatenate([[0.0], np.cumsum(steps)])
    path.write_text("".join(f"{n / HZ:.6f} {at}\n" for n, at in enumerate(meters)))


def mounting(path: Path) -> None:
    """The wheels' middle is 30 cm below the camera."""
    there = np.eye(4)
    there[1, 3] = 0.3
    path.write_text(f"T_cam_imu: {there.tolist()}\n")


def positions(path: Path, names: list[str] | None = None, numbers: slice = slice(None)) -> None:
    """SECONDS X Y Z, or IMAGE X Y Z."""
    centers = ride().cams_from_world.centers()[numbers]
    first = [f"{n / HZ:.6f}" for n in range(len(centers))] if names is None else names
    path.write_text("".join(f"{name} {x} {y} {z}\n" for name, (x, y, z) in zip(first, centers)))


class Capture:
    """The camera at this computer: gives the ride's images."""

    def __init__(self) -> None:
        self.left = [*ride().left]

    def read(self) -> tuple[bool, np.ndarray | None]:
        return (True, self.left.pop(0)[..., ::-1].copy()) if self.left else (False, None)

    def release(self) -> None:
        self.left.clear()
