"""No number in any output of a run is NaN or infinite, and no point is behind a camera that sees it: real sets of images.

The whole run takes all sets in their original size; otherwise it is one, smaller.
"""

import json

import numpy as np
import pytest

import epipole
from epipole.io import read_colmap_model, read_points_ply
from whole import IS_WHOLE

FEW = ("Herz-Jesus-P8",)
MORE = (
    "castle-P19",
    "drone_nadir",
    "fountain-P11",
    "lund_gps",
    "phone_room",
    "sacre_coeur",
    "sceaux_castle",
    "temple_ring",
)


def refuse(constant):
    raise AssertionError(f"{constant} in a JSON file")


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", (*FEW, *MORE) if IS_WHOLE else FEW)
def test_numbers_are_finite_and_points_before_their_cameras(data_dir, tmp_path, name):
    photographs = data_dir / "sfm" / name
    photographs = photographs / "images" if (photographs / "images").is_dir() else photographs
    features = {} if IS_WHOLE else {"max_size_px": 640, "max_features": 1500}
    epipole.reconstruct(photographs, tmp_path / "out", features=epipole.FeatureConfig(**features))
    for file in ("summary.json", "config.json"):
        json.loads((tmp_path / "out" / file).read_text(), parse_constant=refuse)
    assert np.isfinite(read_points_ply(tmp_path / "out" / "points.ply").xyz).all()
    folders = sorted((tmp_path / "out" / "sparse").iterdir())
    assert folders
    for folder in folders:
        model = read_colmap_model(folder)
        poses, points, tracks = model.cams_from_world(), model.points, model.tracks
        for numbers in (
            poses.rotation,
            poses.translation,
            points.xyz_in_world,
            points.error_px,
            model.cameras.params,
        ):
            assert np.isfinite(numbers).all()
        own = points.xyz_in_world[tracks.point_of_observation()]
        depth = (
            np.einsum("ka,ka->k", poses.rotation[tracks.image, 2], own) + poses.translation[tracks.image, 2]
        )
        assert (depth > 0.0).all() and np.isfinite(model.reprojection_errors_px()).all()
