"""Images of any format are undistorted into the format that their suffix names; deep grayscale is mapped alike in all."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from epipole.io import read_colmap_model, write_colmap_model
from epipole.io.images.photographs import read_gray
from epipole.pipelines.undistortion.run import undistort
from io_models import mappable_model

SUFFIXES = (".avif", ".jfif", ".JPG", ".webp", ".tif", ".png")


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """An output folder whose images are named in several formats, and are JPEG all."""
    model = mappable_model()
    names = tuple(f"{n}{SUFFIXES[n % len(SUFFIXES)]}" for n in range(len(model.images)))
    named = replace(model, images=replace(model.images, name=names))
    write_colmap_model(named, tmp_path / "sparse" / "0")
    (tmp_path / "images").mkdir()
    for n, name in enumerate(names):
        camera = model.cameras[int(model.camera_of_image[n])]
        Image.fromarray(np.full((camera.height, camera.width, 3), 30 * n + 20, np.uint8)).save(
            tmp_path / "images" / name, "JPEG"
        )
    return tmp_path


def test_the_format_is_that_of_the_suffix(workspace: Path) -> None:
    out = undistort(workspace)
    model = read_colmap_model(out / "sparse" / "0")
    formats = {".avif": "AVIF", ".webp": "WEBP", ".tif": "TIFF", ".png": "PNG"}
    for n, name in enumerate(sorted(model.images.name)):
        path = out / "images" / name
        with Image.open(path) as image:
            assert image.format == formats.get(path.suffix.lower(), "JPEG")
        assert abs(float(np.median(read_gray(path))) - (30 * n + 20)) <= 3


def test_deep_grayscale_is_mapped_alike(workspace: Path) -> None:
    model = read_colmap_model(workspace / "sparse" / "0")
    names = tuple(f"{n}.png" for n in range(len(model.images)))
    write_colmap_model(replace(model, images=replace(model.images, name=names)), workspace / "sparse" / "0")
    for n, name in enumerate(names):
        camera = model.cameras[int(model.camera_of_image[n])]
        deep = np.full((camera.height, camera.width), 1000, np.uint16)
        deep[: camera.height // 4] = 4000 - 300 * n
        cv2.imwrite(str(workspace / "images" / name), deep)
    out = undistort(workspace)
    grays = [int(np.median(read_gray(out / "images" / name)[-60:-40, 100:-100])) for name in names]
    assert max(grays) == min(grays)
    tops = [int(read_gray(out / "images" / name).max()) for name in names]
    assert tops == sorted(tops, reverse=True) and tops[0] - tops[-1] > 50
