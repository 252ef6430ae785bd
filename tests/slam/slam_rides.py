"""Rendered rides: a camera that goes past the courtyard, with exact truth."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.io import write_trajectory
from epipole.metrics import absolute_error
from epipole.pipelines.slam.frames import DepthCamera, Frame, SlamCamera
from epipole.pipelines.slam.slam import Slam
from epipole.scene import Trajectory
from epipole.synthetic import courtyard, look_at, render, rides
from epipole.synthetic.ride import Ride as SyntheticRide
from epipole.synthetic.ride import RideImage

CAMERA = Camera("PINHOLE", 320, 240, [260.0, 260.0, 159.5, 119.5])
BASELINE = 0.12
RGBD = SlamCamera(CAMERA, None, DepthCamera(CAMERA, Rigid3.identity()))
STEREO, MONO = SlamCamera(CAMERA, BASELINE), SlamCamera(CAMERA)
CAMERAS = {"rgbd": RGBD, "stereo": STEREO, "mono": MONO}
RIGHT_FROM_LEFT = Rigid3(np.eye(3), np.array([-BASELINE, 0.0, 0.0]))


@dataclass(frozen=True)
class Ride:
    """Frames of one ride, with the images of every sensor, and where they were taken."""

    left: tuple
    right: tuple
    depth: tuple
    cams_from_world: Rigid3

    def frames(self, kind: str) -> list[Frame]:
        """As the sensor gives them."""
        out = []
        for n, left in enumerate(self.left):
            right = self.right[n] if kind == "stereo" else None
            out.append(Frame(0.1 * n, left, right, self.depth[n] if kind == "rgbd" else None))
        return out

    def truth(self) -> Rigid3:
        """world_from_body with the first frame as the world."""
        return (self.cams_from_world @ self.cams_from_world[0].inverse()).inverse()


def position(n: int, kind: str) -> Rigid3:
    """Along an arc before the corner; or turning on the spot; or at rest."""
    at = {"arc": n, "turn": 0, "rest": 0}[kind]
    angle = np.deg2rad(-75.0 + 1.4 * at)
    center = np.array([4.4 * np.cos(angle), 4.4 * np.sin(angle), 1.4 + 0.02 * np.sin(0.7 * at)])
    target = np.array([-0.2, 0.4 + 0.02 * np.cos(0.9 * at), 0.6])
    seen = look_at(center, target)
    if kind == "turn":
        seen = Rigid3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(0.8 * n), 0.0])) @ seen
    return seen


class Shared:
    """A folder of frames that all processes of this test run share (`conftest.py`)."""

    folder: Path | None = None


def once(key: str, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """What was made under this key in any process of the test run; two at the same time make the same."""
    if Shared.folder is None:
        return make()
    path = Shared.folder / f"{key}.npz"
    if not path.is_file():
        made = make()
        with tempfile.NamedTemporaryFile(dir=Shared.folder, delete=False) as stream:
            np.savez(stream, **made)
        Path(stream.name).replace(path)
    with np.load(path) as arrays:
        return dict(arrays)


@cache
def rendered_frame(n: int, kind: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left and right image and depth, rendered once for all tests."""
    frame = once(f"{kind}-{n}", lambda: dict(zip(("left", "right", "depth"), _rendered_frame(n, kind))))
    return frame["left"], frame["right"], frame["depth"]


def _rendered_frame(n: int, kind: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    seen = position(n, kind)
    image = render(courtyard(), CAMERA, seen, noise_sigma=1.5, seed=2 * n)
    left = cv2.cvtColor(image.rgb, cv2.COLOR_RGB2GRAY)
    right = left
    if kind == "arc":
        other = render(courtyard(), CAMERA, RIGHT_FROM_LEFT @ seen, noise_sigma=1.5, seed=2 * n + 1)
        right = cv2.cvtColor(other.rgb, cv2.COLOR_RGB2GRAY)
    return left, right, np.nan_to_num(image.depth, nan=0.0).astype(np.float32)


@cache
def ride(kind: str = "arc", count: int = 30) -> Ride:
    """Its first frames."""
    positions = [position(n, kind) for n in range(count)]
    left, right, depth = zip(*(rendered_frame(n, kind) for n in range(count)), strict=True)
    together = Rigid3(np.stack([p.rotation for p in positions]), np.stack([p.translation for p in positions]))
    return Ride(left, right, depth, together)


def tracked(frames: list[Frame], camera: SlamCamera, config=None) -> tuple[Slam, list]:
    """A SLAM that has seen all frames, and its answers."""
    slam = Slam(camera, config)
    return slam, [slam.track(frame) for frame in frames]


def write_pairs(folder: Path, count: int = 12) -> Path:
    """A KITTI-like folder of rendered pairs, with `poses.txt`, which KITTI keeps elsewhere."""
    shown = ride("arc", count)
    for name, images in (("image_0", shown.left), ("image_1", shown.right)):
        (folder / name).mkdir(parents=True)
        for n, image in enumerate(images):
            cv2.imwrite(str(folder / name / f"{n:06d}.png"), image)
    f, _, cx, cy = CAMERA.params
    rows = [[f, 0, cx, x, 0, f, cy, 0, 0, 0, 1, 0] for x in (0.0, -f * BASELINE)]
    (folder / "calib.txt").write_text(
        "".join(f"P{k}: {' '.join(map(str, row))}\n" for k, row in enumerate(rows))
    )
    truth = Trajectory(np.arange(count) * 0.1, shown.truth())
    write_trajectory(truth, folder / "poses.txt", "kitti")
    return folder


@dataclass(frozen=True)
class Rendered:
    """Every few frames of a ride of `epipole.synthetic`, in small images."""

    ride: SyntheticRide
    images: dict

    def frames(self, kind: str, numbers=None) -> list[Frame]:
        """As the sensor gives them, a tenth of a second apart, in the order of these numbers (all of them, in order)."""
        out = []
        for n, number in enumerate(self.images if numbers is None else numbers):
            left, right, depth = self.images[number]
            kinds = right if kind == "stereo" else None, depth if kind == "rgbd" else None
            out.append(Frame(0.1 * n, left, *kinds))
        return out

    def truth(self, numbers=None) -> Rigid3:
        """world_from_body with the first of these frames as the world."""
        positions = self.ride.world_from_camera[np.array(list(self.images if numbers is None else numbers))]
        return positions[0].inverse() @ positions

    def sensor(self, kind: str, focal_factor: float = 1.0) -> SlamCamera:
        """The camera, or one of a wrong focal length."""
        camera, params = self.ride.camera, self.ride.camera.params.copy()
        params[:2] *= focal_factor
        camera = Camera(camera.model, camera.width, camera.height, params)
        if kind == "rgbd":
            return SlamCamera(camera, None, DepthCamera(camera, Rigid3.identity()))
        return SlamCamera(camera, self.ride.baseline if kind == "stereo" else None)


@cache
def rendered(name: str, count: int, step: int, *, with_right: bool = False) -> Rendered:
    """Every `step`-th of the first `count` frames, rendered once for all tests of a process.

    Frames of the room do not depend on how many there are: these are rendered once for all tests.
    """
    ride = getattr(rides, name)(count, (320, 240))
    images = {}
    for number in range(0, count, step):
        if name == "loop_room":
            left = once(f"{name}-{number}", lambda: _arrays(ride.left(number)))  # noqa: B023 - called at once
        else:
            left = _arrays(ride.left(number))
        images[number] = left["gray"], ride.right(number).gray if with_right else None, left["depth"]
    return Rendered(ride, images)


def _arrays(image: RideImage) -> dict[str, np.ndarray]:
    return {"gray": image.gray, "depth": image.depth}


def errors(slam: Slam, truth: Rigid3, alignment: str, number: int = 0):
    """Of a path whose frames are a tenth of a second apart."""
    path = slam.trajectory(number)
    rows = np.rint(10 * path.timestamp_s).astype(int)
    return absolute_error(path.world_from_body, truth[rows], alignment)
