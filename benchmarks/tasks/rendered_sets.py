"""Large sets of rendered images with exact poses: a room that the camera circles, a street of a kilometer with GPS, and a yard in 12 megapixels.

Images are written once; a complete folder is reused. Poses and fixes are kept beside the images, in truth.npz.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.io.images.photographs import write_jpeg_with_exif
from epipole.scene import Georeference
from epipole.synthetic import Box, Plane, Sphere, SyntheticScene, courtyard, courtyard_views, render
from epipole.synthetic.rides import facing, loop_room
from epipole.synthetic.scene import Primitive, Vector

WIDTH, HEIGHT, QUALITY = 640, 480, 95
NOISE_GRAY = 2.0
"""Standard deviation of the sensor noise, in gray levels of 255."""
FOCAL_35MM = 26.0
"""Of the street's camera: a whole number, because EXIF stores whole millimeters."""
FOCAL_PX = FOCAL_35MM / 36.0 * WIDTH
GPS_SIGMA_M = np.array([2.0, 2.0, 3.0])
"""Standard deviations of the fixes: east, north, up."""
ORIGIN = np.array([48.2, 11.6, 520.0])
"""Latitude and longitude in degrees and altitude in meters of the start of the street."""
PHOTOGRAPH = 4000, 3000
"""Width and height of the yard's images."""
ENLARGED = 2
"""How many times smaller these are rendered than written: this takes a quarter of the time."""
HALF_STREET_M, SIGHT_M, BEHIND_M = 6.0, 180.0, 25.0
"""From the center line to the facades; how far ahead and behind the camera things are rendered."""
CROSSING_M = (60.0, 100.0)
"""Range of the distance between side streets."""
STREET_SEED = 3
"""Of the houses, cars and trees."""


@dataclass(frozen=True, slots=True, eq=False)
class RenderedSet:
    """Images on disk, and the truth; arrays are in the order of `names`."""

    name: str
    images: Path
    names: tuple[str, ...]
    cams_from_world: Rigid3
    camera_params: tuple[float, ...] | None
    """Intrinsics that programs are given, in COLMAP's pixel coordinates; None if EXIF has the focal length."""
    lat_lon_alt: np.ndarray | None
    """(n, 3) true positions in degrees, degrees and meters; None without GPS."""
    render_s: float
    """Seconds that rendering took when the images were written."""


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """What to render and to write."""

    camera: Camera
    cams_from_world: Rigid3
    scene_of: Callable[[int], SyntheticScene]
    """The scene, or the part of it that an image sees."""
    is_located: bool = False
    enlarged: int = 1
    """How many times smaller the images are rendered than they are written."""


def prepare_set(name: str, num_images: int, folder: Path, seed: int = STREET_SEED) -> RenderedSet:
    """Write the images of a set of `SETS` to a folder below `folder`, unless they are there.

    Each seed is another street.
    """
    from time import perf_counter

    at = folder / (f"{name}_{num_images}" if seed == STREET_SEED else f"{name}_{num_images}_seed_{seed}")
    images, truth = at / "images", at / "truth.npz"
    names = tuple(f"frame_{k:04d}.jpg" for k in range(num_images))
    plan = SETS[name](num_images, seed)
    lat_lon_alt = _lat_lon_alt(plan.cams_from_world.centers()) if plan.is_located else None
    if not truth.is_file():  # written last
        images.mkdir(parents=True, exist_ok=True)
        start = perf_counter()
        _write_images(plan, images, names, lat_lon_alt)
        poses = plan.cams_from_world
        np.savez(
            truth,
            names=names,
            rotation=poses.rotation,
            translation=poses.translation,
            lat_lon_alt=np.full((num_images, 3), np.nan) if lat_lon_alt is None else lat_lon_alt,
            render_s=perf_counter() - start,
        )
    fx, fy, cx, cy = map(float, plan.camera.params)
    given = None if plan.is_located else (fx, fy, cx + 0.5, cy + 0.5)
    with np.load(truth) as stored:
        poses, render_s = Rigid3(stored["rotation"], stored["translation"]), float(stored["render_s"])
    return RenderedSet(name, images, names, poses, given, lat_lon_alt, render_s)


def _write_images(plan: _Plan, folder: Path, names: tuple[str, ...], lat_lon_alt: np.ndarray | None) -> None:
    fixes = None if lat_lon_alt is None else _with_noise(plan.cams_from_world.centers())
    size = plan.camera.width, plan.camera.height
    camera = plan.camera.scaled_to(size[0] // plan.enlarged, size[1] // plan.enlarged)
    for k, name in enumerate(names):
        image = render(plan.scene_of(k), camera, plan.cams_from_world[k], noise_sigma=NOISE_GRAY, seed=k)
        if fixes is None:
            rgb = cv2.resize(
                image.rgb, size, interpolation=cv2.INTER_CUBIC
            )  # the same image if it has that size
            write_jpeg_with_exif(folder / name, rgb, quality=QUALITY)
        else:
            lat_deg, lon_deg, alt_m = map(float, fixes[k])
            gps = (lat_deg, lon_deg, alt_m)
            write_jpeg_with_exif(folder / name, image.rgb, focal_35mm=FOCAL_35MM, gps=gps, quality=QUALITY)


def _with_noise(centers: np.ndarray) -> np.ndarray:
    """Fixes of cameras at centers (n, 3), with noise."""
    rng = np.random.default_rng(7)
    return _lat_lon_alt(centers + GPS_SIGMA_M * rng.normal(size=centers.shape))


def _lat_lon_alt(enu: np.ndarray) -> np.ndarray:
    """WGS84 positions of points (n, 3) in meters east, north and up of `ORIGIN`."""
    return Georeference(*ORIGIN.tolist()).lat_lon_alt_of(enu)


def enu_about(lat_lon_alt: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Meters east, north and up of a position."""
    return Georeference(*origin.tolist()).enu_of(lat_lon_alt)


def _room_plan(num_images: int, _seed: int) -> _Plan:
    ride = loop_room(num_frames=num_images, size=(WIDTH, HEIGHT))
    scene = ride.scene_at(0.0)
    return _Plan(ride.camera, ride.world_from_camera.inverse(), lambda _: scene)


def _yard_plan(num_images: int, _seed: int) -> _Plan:
    """Photographs on an arc, all of which show the same yard."""
    width, height = PHOTOGRAPH
    focal_px = FOCAL_35MM / 36.0 * width
    camera = Camera("PINHOLE", width, height, [focal_px, focal_px, (width - 1) / 2, (height - 1) / 2])
    scene = courtyard()
    return _Plan(camera, courtyard_views(num_images), lambda _: scene, enlarged=ENLARGED)


def _street_plan(num_images: int, seed: int) -> _Plan:
    """One image a meter along the street."""
    camera = Camera("PINHOLE", WIDTH, HEIGHT, [FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    rng = np.random.default_rng(seed)
    length_m = num_images + SIGHT_M
    center_line = _CenterLine(length_m)
    ground = center_line.ground()
    things = [*_houses(center_line, rng), *_parked_cars(center_line, rng), *_trees(center_line, rng)]
    at_m = np.array([meter for meter, _ in things])
    walked_m = np.arange(num_images, dtype=np.float64)

    def scene_of(k: int) -> SyntheticScene:
        in_sight = (at_m > walked_m[k] - BEHIND_M) & (at_m < walked_m[k] + SIGHT_M)
        return SyntheticScene.of([ground, *(things[i][1] for i in np.flatnonzero(in_sight))])

    return _Plan(camera, _walk(center_line, walked_m).inverse(), scene_of, is_located=True)


class _CenterLine:
    """A gently curved line in the plane, by arc length."""

    def __init__(self, length_m: float) -> None:
        self.meter = np.arange(-BEHIND_M, length_m, 0.5)
        self.heading = np.deg2rad(
            25.0
            + 7.0 * np.sin(2 * np.pi * self.meter / 310.0)
            + 4.0 * np.sin(2 * np.pi * self.meter / 137.0 + 1.0)
        )
        steps = 0.5 * np.stack([np.cos(self.heading), np.sin(self.heading)], axis=1)
        self.position = np.cumsum(steps, axis=0)
        self.position -= self.position[np.searchsorted(self.meter, 0.0)]

    def heading_at(self, meter: np.ndarray | float) -> np.ndarray:
        """Heading in radians, from east to north."""
        return np.interp(meter, self.meter, self.heading)

    def beside(self, meter: np.ndarray | float, left_m: np.ndarray | float) -> np.ndarray:
        """(..., 2) positions at a distance to the left of the line."""
        heading = self.heading_at(meter)
        x, y = (np.interp(meter, self.meter, self.position[:, c]) for c in (0, 1))
        return np.stack([x - left_m * np.sin(heading), y + left_m * np.cos(heading)], axis=-1)

    def ground(self) -> Plane:
        """A ground plane far beyond the street."""
        low, high = self.position.min(axis=0) - 400.0, self.position.max(axis=0) + 400.0
        (x, y), (half_x, half_y) = 0.5 * (low + high), 0.5 * (high - low)
        return Plane(
            center=(float(x), float(y), 0.0), direction_u=(1, 0, 0), direction_v=(0, 1, 0),
            half_size=(float(half_x), float(half_y)), color=(0.42, 0.41, 0.40), seed=5,
        )  # fmt: skip

    def box(
        self, meter: float, left_m: float, half_size: Vector, color: Vector, seed: int, bottom_m: float = 0.0
    ) -> tuple[float, Box]:
        """A box on the ground, aligned with the street, and where it is along the street."""
        x, y = map(float, self.beside(meter, left_m))
        angle = float(self.heading_at(meter))
        center = (x, y, bottom_m + half_size[2])
        return meter, Box(center=center, half_size=half_size, angle_rad=angle, color=color, seed=seed)


def _walk(center_line: _CenterLine, meter: np.ndarray) -> Rigid3:
    """world_from_camera of a phone held by hand: forward, with a look to the left and the right in turn."""
    sway = 0.5 * np.sin(0.11 * meter) + 0.06 * np.sin(1.9 * meter + 0.5)
    height = 1.6 + 0.05 * np.sin(2.3 * meter) + 0.04 * np.sin(0.7 * meter)
    look = np.deg2rad(12.0) * np.sin(0.9 * meter) + np.deg2rad(2.0) * np.sin(2.7 * meter)
    pitch = np.deg2rad(3.0 + 1.5 * np.sin(1.3 * meter))
    roll = np.deg2rad(1.5) * np.sin(1.7 * meter)
    center = np.column_stack([center_line.beside(meter, sway), height])
    return facing(center, center_line.heading_at(meter) + look, pitch, roll)


def _color(rng: np.random.Generator) -> Vector:
    red, green, blue = rng.uniform(0.32, 0.66, 3)
    return float(red), float(green), float(blue)


def _houses(center_line: _CenterLine, rng: np.random.Generator) -> list[tuple[float, Primitive]]:
    """Both rows of houses, with oriels, and with side streets between blocks."""
    out: list[tuple[float, Primitive]] = []
    end = center_line.meter[-1]
    for side in (1.0, -1.0):
        meter, crossing = -BEHIND_M, rng.uniform(*CROSSING_M)
        while meter < end:
            if meter > crossing:
                meter += rng.uniform(7.0, 12.0)
                crossing = meter + rng.uniform(*CROSSING_M)
            width, depth, height = rng.uniform(6.0, 14.0), rng.uniform(8.0, 13.0), rng.uniform(5.0, 14.0)
            front, middle, seed = (
                HALF_STREET_M + rng.uniform(0.0, 1.8),
                meter + 0.5 * width,
                len(out) * 100 + 1000,
            )
            half = (0.5 * width, 0.5 * depth, 0.5 * height)
            out.append(center_line.box(middle, side * (front + 0.5 * depth), half, _color(rng), seed))
            if rng.random() < 0.6:  # an oriel
                along, above = rng.uniform(-0.25, 0.25) * width, rng.uniform(2.4, 3.0)
                half = (rng.uniform(0.8, 1.6), 0.45, rng.uniform(0.6, 1.2))
                out.append(
                    center_line.box(middle + along, side * (front - 0.3), half, _color(rng), seed + 50, above)
                )
            meter += width + (rng.uniform(1.0, 3.0) if rng.random() < 0.25 else 0.0)
    return out


def _parked_cars(center_line: _CenterLine, rng: np.random.Generator) -> list[tuple[float, Primitive]]:
    """A body and a cabin each."""
    out: list[tuple[float, Primitive]] = []
    for side in (1.0, -1.0):
        meter = 4.0
        while meter < center_line.meter[-1]:
            left, color, seed = side * rng.uniform(3.6, 3.9), _color(rng), 500_000 + 100 * len(out)
            out.append(center_line.box(meter, left, (2.1, 0.85, 0.42), color, seed, 0.2))
            half = (1.1, 0.75, 0.28)
            out.append(center_line.box(meter - 0.3, left, half, _color(rng), seed + 50, 1.04))
            meter += 5.5 + rng.exponential(9.0)
    return out


def _trees(center_line: _CenterLine, rng: np.random.Generator) -> list[tuple[float, Primitive]]:
    """A trunk and a crown each."""
    out: list[tuple[float, Primitive]] = []
    meter = 12.0
    while meter < center_line.meter[-1]:
        left, seed = rng.choice([-1.0, 1.0]) * 5.0, 900_000 + 100 * len(out)
        out.append(center_line.box(meter, left, (0.13, 0.13, 1.3), (0.40, 0.32, 0.24), seed))
        x, y = map(float, center_line.beside(meter, left))
        radius = float(rng.uniform(0.7, 1.1))
        crown = Sphere(center=(x, y, 2.5 + radius), radius=radius, color=(0.34, 0.48, 0.28), seed=seed + 50)
        out.append((meter, crown))
        meter += 8.0 + rng.exponential(14.0)
    return out


SETS: dict[str, Callable[[int, int], _Plan]] = {
    "loop_room": _room_plan,
    "street": _street_plan,
    "yard": _yard_plan,
}
