"""Bundle problems in BAL's format: what is written is read again, Snavely's camera is ours turned around, bad files say why."""

import bz2
from dataclasses import replace

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.errors import FileFormatError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.io import read_bal, write_bal
from epipole.optim import adjust_bundle


@pytest.fixture
def text(rng):
    """Two of Snavely's cameras, five points, and pixels by his equation with noise."""
    cameras = np.concatenate(
        [0.1 * rng.normal(size=(2, 6)), [[500.0, 1e-2, -1e-3], [450.0, -2e-2, 1e-3]]], axis=1
    )
    cameras[:, 5] -= 5.0
    points = rng.uniform(-1, 1, (5, 3))
    lines = ["2 5 10"]
    for j in (3, 0, 1, 4, 2):  # not in order
        for c in range(2):
            lines.append(f"{c} {j} " + " ".join(map(repr, snavely(cameras[c], points[j]).tolist())))
    numbers = [*cameras.ravel().tolist(), *points.ravel().tolist()]
    return "\n".join([*lines, *map(repr, numbers)]) + "\n", cameras, points


def snavely(camera, point):
    x = Rotation3.exp(camera[None, :3]).matrix[0] @ point + camera[3:6]
    p = -x[:2] / x[2]
    r2 = p @ p
    return camera[6] * (1 + camera[7] * r2 + camera[8] * r2 * r2) * p


@pytest.mark.parametrize("suffix", [".txt", ".txt.bz2"])
def test_snavelys_camera_is_ours_turned_around(tmp_path, text, suffix):
    path = tmp_path / f"problem{suffix}"
    data = text[0].encode()
    path.write_bytes(bz2.compress(data) if suffix.endswith("bz2") else data)
    problem = read_bal(path)
    assert adjust_bundle(problem).initial_cost < 1e-18  # noise-free: every pixel is its point's projection
    assert problem.offsets.tolist() == [0, 2, 4, 6, 8, 10] and (problem.camera == problem.frame).all()
    camera = Camera(CameraModel.RADIAL, 2, 2, problem.camera_params[1, :5])
    in_cam = problem.rig_from_world[1].apply(text[2][3])
    expected = snavely(text[1][1], text[2][3])
    np.testing.assert_allclose(camera.project(in_cam[None])[0], expected * [1, -1], rtol=1e-12)


def test_what_the_format_does_not_hold_raises(tmp_path, text):
    source = tmp_path / "in.txt"
    source.write_text(text[0])
    problem = read_bal(source)
    path = tmp_path / "out.txt"
    with pytest.raises(ShapeError, match="principal point"):
        write_bal(path, replace(problem, camera_params=problem.camera_params + 1.0))
    with pytest.raises(ShapeError, match="RADIAL"):
        write_bal(path, replace(problem, camera_model=np.zeros(2, np.int32)))
    with pytest.raises(ShapeError, match="rigs"):
        write_bal(path, replace(problem, cam_from_rig=Rigid3(np.eye(3)[None], np.ones((1, 3)))))
    assert not path.exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t[: len(t) // 2], "numbers after the first three"),
        (lambda t: t.replace("2 5 10", "2 five 10", 1), "not a bundle adjustment problem"),
        (lambda t: t.replace("2 5 10", "2 5 -10", 1), "counts are inconsistent"),
        (lambda t: t.replace("\n1 3 ", "\n7 3 ", 1), "missing camera or point"),
        (lambda t: t.replace("500.0", "nan", 1), "not finite"),
        (lambda t: "", "not a bundle adjustment problem"),
    ],
)
def test_broken_files_say_why(tmp_path, text, change, message):
    path = tmp_path / "broken.txt"
    path.write_text(change(text[0]))
    with pytest.raises(FileFormatError, match=message):
        read_bal(path)


def test_missing_or_spoilt_archives_say_why(tmp_path):
    with pytest.raises(FileFormatError, match="it does not exist"):
        read_bal(tmp_path / "none.txt")
    spoilt = tmp_path / "spoilt.txt.bz2"
    spoilt.write_bytes(bz2.compress(b"1 1 1")[:-4])
    with pytest.raises(FileFormatError, match="cannot be read"):
        read_bal(spoilt)
