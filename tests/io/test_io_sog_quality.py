"""How near a SOG with harmonics comes to the original, by the size of its palette."""

import json
import zipfile

import numpy as np

from epipole.cameras import Camera
from epipole.fields.splat.rasterizer import render
from epipole.io.gaussians.sog import read_sog, write_sog
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.synthetic import look_at

COUNT, LEAST_DB = 5000, 37.0
"""With half of the palette it is 33 dB."""
CAMERA = Camera("PINHOLE", 96, 80, [90.0, 90.0, 47.5, 39.5])


def cloud_of_degree_3() -> GaussianCloud:
    """Harmonics as noisy as those of a training."""
    rng = np.random.default_rng(0)
    arrays = (
        *(rng.uniform(-1, 1, (COUNT, 3)), rng.uniform(-4, -3, (COUNT, 3)), rng.normal(size=(COUNT, 4))),
        *(rng.uniform(-2, 2, COUNT), 0.1 * rng.normal(size=(COUNT, 16, 3))),
    )
    return GaussianCloud(*(array.astype(np.float32) for array in arrays))


def test_harmonics_have_a_large_palette(tmp_path):
    cloud = cloud_of_degree_3()
    write_sog(tmp_path / "a.sog", cloud)
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert json.loads(archive.read("meta.json"))["shN"]["count"] > 0.9 * 4096
    found = read_sog(tmp_path / "a.sog")
    for position in (look_at((0, -3, 1), (0, 0, 0)), look_at((2.5, 1, -1), (0, 0, 0))):
        one, other = (render(c, CAMERA, position).color for c in (cloud, found))
        assert -10 * np.log10(np.mean((one - other) ** 2)) > LEAST_DB
