"""Known cameras: COLMAP, Strecha, Middlebury, transforms.json."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from epipole.errors import FileFormatError
from epipole.io import (
    read_truth,
    write_colmap_model,
    write_metashape,
    write_opensfm,
    write_realityscan,
    write_transforms,
)
from epipole.io.truth import is_truth_of_images
from epipole.pipelines.evaluation.run import evaluate
from epipole.scene import Reconstruction
from io_models import mappable_model, small_model

DATA = Path(os.environ.get("EPIPOLE_DATA", Path(__file__).parents[2].parent / "shared" / "data")) / "sfm"

R = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])


def strecha_text(world_from_cam: np.ndarray, center: np.ndarray) -> str:
    rows = "\n".join(" ".join(map(str, row)) for row in world_from_cam)
    return f"100 0 50\n0 100 40\n0 0 1\n0 0 0\n{rows}\n{' '.join(map(str, center))} \n100 80\n"


def test_strecha(tmp_path: Path) -> None:
    center = np.array([1.0, -2.0, 3.0])
    for name in ("b.png", "a.png"):
        (tmp_path / f"{name}.camera").write_text(strecha_text(R, center))
    truth = read_truth(tmp_path)
    assert truth.names == ("a.png", "b.png") and len(truth) == 2
    np.testing.assert_allclose(truth.cams_from_world.rotation[0], R.T, atol=1e-15)
    np.testing.assert_allclose(truth.cams_from_world.centers(), [center, center], atol=1e-14)
    # A point one meter before the camera lies on its viewing direction in the world, the last column of R.
    np.testing.assert_allclose(truth.cams_from_world[0].apply(center + R[:, 2]), [0, 0, 1], atol=1e-14)


def test_middlebury(tmp_path: Path) -> None:
    K = np.array([[100, 0, 50], [0, 110, 40], [0, 0, 1.0]])
    t = np.array([0.1, 0.2, 3.0])
    words = " ".join(map(str, [*K.ravel(), *R.ravel(), *t]))
    (tmp_path / "x_par.txt").write_text(f"1\nview1.png {words}\n")
    for path in (tmp_path, tmp_path / "x_par.txt"):
        truth = read_truth(path)
        assert truth.names == ("view1.png",)
        np.testing.assert_allclose(
            truth.cams_from_world.as_matrix()[0, :3], np.column_stack([R, t]), atol=1e-15
        )


def test_models(tmp_path: Path) -> None:
    model = small_model()
    expected = model.cams_from_world()[np.arange(8)].as_matrix()
    write_colmap_model(model, tmp_path / "sparse")
    write_transforms(model, tmp_path / "transforms.json")
    for path in (tmp_path / "sparse", tmp_path / "transforms.json"):
        truth = read_truth(path)
        assert truth.names == model.images.name[:8]
        np.testing.assert_allclose(truth.cams_from_world.as_matrix(), expected, atol=1e-12)


@pytest.mark.skipif(not (DATA / "fountain-P11").is_dir(), reason="sfm/fountain-P11 is not in the data folder")
def test_fountain() -> None:
    truth = read_truth(DATA / "fountain-P11" / "gt_dense_cameras")
    assert truth.names == tuple(f"{i:04d}.jpg" for i in range(11))
    np.testing.assert_allclose(truth.cams_from_world.centers()[0], [-7.28137, -7.57667, 0.204446], atol=1e-9)
    rotation = truth.cams_from_world.rotation
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, 1, 2), np.broadcast_to(np.eye(3), (11, 3, 3)), atol=1e-12
    )
    # The cameras go around the fountain: they see a common point before them.
    middle = truth.cams_from_world.inverse().apply(np.array([0.0, 0.0, 8.0])).mean(axis=0)
    assert (truth.cams_from_world.apply(middle)[:, 2] > 1).all()


@pytest.mark.skipif(not (DATA / "temple_ring").is_dir(), reason="sfm/temple_ring is not in the data folder")
def test_temple() -> None:
    truth = read_truth(DATA / "temple_ring")
    assert len(truth) == 47 and truth.names[0] == "templeR0001.png"
    # From the README of the set: the temple is in this box, and every camera sees it before itself.
    box = np.array([[-0.023121, -0.038009, -0.091940], [0.078626, 0.121636, -0.017395]])
    depth = truth.cams_from_world.apply(box.mean(axis=0))[:, 2]
    assert depth.min() > 0.4 and depth.max() < 0.8


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.camera", "1 2 3\n", "9 lines, this one has 1"),
        ("a.camera", strecha_text(2 * R, np.zeros(3)), "lines 5 to 7: not a rotation"),
        ("a.camera", strecha_text(R, np.zeros(2)), "line 8: 3 finite numbers expected, got 2"),
        ("a.camera", strecha_text(R, np.array([0, np.nan, 0])), "line 8"),
        ("a.camera", strecha_text(R, np.zeros(3)).replace("0.6", "x"), "lines 5 to 7"),
        ("a_par.txt", "", "number of cameras"),
        ("a_par.txt", "2\nx " + "1 " * 12 + "1 0 0 0 1 0 0 0 1", "line 2: not a rotation|number of cameras"),
        ("a_par.txt", "1\nx 1 2 3\n", "line 2: 21 finite numbers expected, got 3"),
        ("a.txt", "hello", "not cameras in a supported format"),
    ],
)
def test_broken_files_are_refused(tmp_path: Path, name: str, content: str, message: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(FileFormatError, match=message):
        read_truth(tmp_path)


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="it does not exist"):
        read_truth(tmp_path / "nothing")
    with pytest.raises(
        FileFormatError,
        match="not cameras in a supported format; it is empty; supported are an output folder of `reconstruct`, a folder with",
    ):
        read_truth(tmp_path)


@pytest.mark.parametrize("write", [write_metashape, write_realityscan, write_opensfm])
def test_cameras_of_another_program(tmp_path: Path, write: Callable[[Reconstruction, Path], None]) -> None:
    model = mappable_model()
    path = tmp_path / {"write_metashape": "a.xml", "write_realityscan": "a.csv"}.get(write.__name__, "a.json")
    for row, name in enumerate(model.images.name):
        camera = model.cameras[int(model.camera_of_image[row])]
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (camera.width, camera.height)).save(tmp_path / "images" / name)
    write(model, path)
    truth = read_truth(path)
    ours = dict(zip(model.images.name, model.cams_from_world().translation))
    for name, translation in zip(truth.names, truth.cams_from_world.translation, strict=True):
        np.testing.assert_allclose(ours[name], translation, atol=1e-6)
    write_colmap_model(model, tmp_path / "sparse" / "0")
    found = evaluate(path, tmp_path)
    assert found.num_registered == len(truth) and found.position_max < 1e-6


def test_an_output_folder(tmp_path: Path) -> None:
    """The model inside of it, as where the estimate is one."""
    model = small_model()
    write_colmap_model(model, tmp_path / "sparse" / "0")
    assert [path.name for path in tmp_path.iterdir()] == ["sparse"]
    assert is_truth_of_images(tmp_path)
    assert set(read_truth(tmp_path).names) <= set(model.images.name)
