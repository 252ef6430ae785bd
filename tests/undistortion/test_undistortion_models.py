"""Any of several models can be undistorted, by its number or its folder, wherever the results are to lie."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from epipole.errors import FileFormatError
from epipole.io import read_colmap_model, write_colmap_model
from epipole.pipelines.undistortion.run import undistort
from io_models import mappable_model


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """An output folder with two models of different images."""
    out, model = tmp_path / "out", mappable_model()
    (out / "images").mkdir(parents=True)
    for number in range(2):
        names = tuple(f"model{number}_{n}.png" for n in range(len(model.images)))
        named = replace(model, images=replace(model.images, name=names))
        write_colmap_model(named, out / "sparse" / str(number))
        for n, name in enumerate(names):
            camera = model.cameras[int(model.camera_of_image[n])]
            gray = np.full((camera.height, camera.width, 3), 40 * n, np.uint8)
            Image.fromarray(gray).save(out / "images" / name)
    return out


def first_name(folder: Path) -> str:
    name = read_colmap_model(folder / "sparse" / "0").images.name[0]
    assert (folder / "images" / name).is_file()
    return str(name)


def test_the_largest_model_is_the_usual_one(workspace: Path) -> None:
    for given in (workspace, workspace / "sparse" / "0"):
        assert undistort(given) == workspace / "undistorted"
    assert undistort(workspace, model=0) == workspace / "undistorted"
    assert first_name(workspace / "undistorted").startswith("model0")


def test_a_further_model_has_a_folder_of_its_own(workspace: Path, tmp_path: Path) -> None:
    for given, number in ((workspace, 1), (workspace / "sparse" / "1", None)):
        assert undistort(given, model=number) == workspace / "undistorted-1"
    assert first_name(workspace / "undistorted-1").startswith("model1")
    assert undistort(workspace / "sparse" / "1", target=tmp_path / "dest") == tmp_path / "dest"
    assert first_name(tmp_path / "dest").startswith("model1")


def test_no_such_model(workspace: Path, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="holds no model 7; there are 0, 1"):
        undistort(workspace, model=7)
    with pytest.raises(FileFormatError, match="holds no models"):
        undistort(tmp_path / "nothing", model=1)
