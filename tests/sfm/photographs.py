"""Rendered photographs for the tests of the main job."""

from pathlib import Path

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3
from epipole.io.images.photographs import write_jpeg_with_exif
from epipole.synthetic import courtyard, courtyard_views, render

WIDTH, HEIGHT, FOCAL_35MM = 480, 320, 30.0
CAMERA = Camera(
    CameraModel.SIMPLE_RADIAL, WIDTH, HEIGHT, np.array([FOCAL_35MM / 36 * WIDTH, 239.5, 159.5, -0.04])
)


def render_to(folder: Path, cams_from_world: Rigid3, prefix: str = "view") -> list[str]:
    folder.mkdir(parents=True, exist_ok=True)
    names = []
    for n in range(len(cams_from_world)):
        names.append(f"{prefix}_{n:02d}.jpg")
        image = render(courtyard(), CAMERA, cams_from_world[n], noise_sigma=1.5, seed=n)
        write_jpeg_with_exif(folder / names[-1], image.rgb, focal_35mm=FOCAL_35MM)
    return names


def neighboring_views(count: int = 6) -> Rigid3:
    return courtyard_views(24)[np.arange(6, 6 + count)]
