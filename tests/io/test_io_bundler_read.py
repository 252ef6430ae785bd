"""Bundler's bundle.out is read: in the form that Bundler writes, there and back, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_io_bundler import bundler_model

from epipole.errors import FileFormatError
from epipole.io import read_bundler, read_model, write_bundler
from io_models import mappable_model

EXAMPLE = """# Bundle file v0.3
3 2
6.6468549721e+02 -1.5e-01 2.0e-02
1.0000000000e+00 0.0 0.0
0.0 1.0000000000e+00 0.0
0.0 0.0 1.0000000000e+00
1.0e-01 2.0e-01 3.0e-01
0 0 0
0 0 0
0 0 0
0 0 0
0 0 0
7.0e+02 0 0
0.0 -1.0 0.0
1.0 0.0 0.0
0.0 0.0 1.0
0 0 0
5.0e-01 -2.5e-01 -4.0e+00
159 144 133
2 0 12 106.5 -20.25 2 7 -3.5 8.75
1.0 1.0 -5.0
255 0 10
0
"""
LIST = "./a.jpg 0 660.5\nb.jpg\nimages/c d.jpg 0 700\n"


def written(folder: Path, text: str = EXAMPLE, names: str = LIST) -> Path:
    (folder / "images").mkdir(exist_ok=True)
    Image.new("RGB", (640, 480)).save(folder / "a.jpg")
    Image.new("RGB", (480, 640)).save(folder / "images" / "c d.jpg")
    (folder / "bundle.out").write_text(text)
    (folder / "list.txt").write_text(names)
    return folder / "bundle.out"


def test_a_file_in_the_form_of_bundler(tmp_path: Path) -> None:
    """Cameras look along -z, y is up, and pixels are relative to the middle of the image."""
    with pytest.warns(RuntimeWarning, match="cameras that are not registered are not read: 1"):
        model = read_bundler(written(tmp_path))
    assert model.images.name == ("a.jpg", "c d.jpg")
    np.testing.assert_allclose(model.cameras[0].params, [664.68549721, 319.5, 239.5, -0.15, 0.02])
    assert (model.cameras[1].width, model.cameras[1].height) == (480, 640)
    np.testing.assert_allclose(model.cams_from_world().rotation[0], np.diag([1, -1, -1]))
    np.testing.assert_allclose(model.cams_from_world().translation[0], [0.1, -0.2, -0.3])
    assert model.points.rgb.tolist() == [[159, 144, 133], [255, 0, 10]]
    assert model.tracks.offsets.tolist() == [0, 2, 2] and model.tracks.image.tolist() == [0, 1]
    np.testing.assert_allclose(model.observed_pixels(), [[319.5 + 106.5, 239.5 + 20.25], [236.0, 310.75]])
    # Bundler's own projection: p = -P / P.z, then f r(p) p.
    P = np.array([0.5 + 0.1, -0.25 + 0.2, -4.0 + 0.3])
    p = -P[:2] / P[2]
    x, y = 664.68549721 * (1 - 0.15 * p @ p + 0.02 * (p @ p) ** 2) * p
    found = model.cameras[0].project(model.cams_from_world()[0].apply(model.points.xyz_in_world[:1]))[0]
    np.testing.assert_allclose(found, [319.5 + x, 239.5 - y], atol=1e-9)


@pytest.mark.parametrize("model", [mappable_model(), bundler_model()])
def test_there_and_back(tmp_path: Path, model) -> None:
    """The keypoints of a camera off the center are moved with it: the format has no principal point."""
    known = np.flatnonzero(model.is_registered())
    for name in model.images.name:
        (tmp_path / "images").mkdir(exist_ok=True)
        Image.new("RGB", (640, 480)).save(tmp_path / "images" / name)
    write_bundler(model, tmp_path / "bundle.out", "images")
    found = read_model(tmp_path)
    assert found.images.name == tuple(model.images.name[k] for k in known)
    matrices = model.cams_from_world().as_matrix()[known]
    np.testing.assert_allclose(found.cams_from_world().as_matrix(), matrices, atol=1e-12)
    np.testing.assert_allclose(found.points.xyz_in_world, model.points.xyz_in_world, atol=1e-12)
    np.testing.assert_array_equal(found.points.rgb, model.points.rgb)
    expected = model.reprojection_errors_px()[np.isin(model.tracks.image, known)]
    np.testing.assert_allclose(found.reprojection_errors_px(), expected, atol=1e-8)


def test_the_list_that_colmap_writes(tmp_path: Path) -> None:
    path = written(tmp_path)
    path.rename(tmp_path / "x.bundle.out")
    (tmp_path / "list.txt").rename(tmp_path / "x.list.txt")
    with pytest.warns(RuntimeWarning):
        assert len(read_model(tmp_path / "x.bundle.out").images) == 2


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("v0.3", "v0.1", "line 1: expected '# Bundle file v0.3'"),
        ("3 2\n", "3 200\n", "it ends before the last of its 3 cameras and 200 points"),
        ("3 2\n", "-1 2\n", "it ends before"),
        ("3 2\n", "3.5 2\n", "not numbers after line 1"),
        ("159 144 133", "159 144 x", "not numbers"),
        ("159 144 133", "159 144 300", "a color is not from 0 to 255"),
        ("159 144 133", "159 144 nan", "not finite"),
        ("2 0 12", "3 0 12", "its list of views is invalid or incomplete"),
        ("2 0 12", "2.5 0 12", "its list of views is invalid or incomplete"),
        ("2 0 12", "2 9 12", "refers to a camera or keypoint that does not exist"),
        ("2 0 12", "2 1 12", "refers to a camera that is not registered"),
        ("2 0 12", "2 0 1.5", "refers to a camera or keypoint"),
        ("255 0 10\n0\n", "255 0 10\n0 1 2\n", "2 unexpected numbers after the last point"),
        ("255 0 10\n0\n", "255 0 10\n", "point 1"),
        ("0.0 -1.0 0.0", "0.0 1.0 0.0", "camera 2: its matrix is not a rotation"),
        ("6.6468549721e+02", "-6.6e+02", "the camera of a.jpg"),
        ("6.6468549721e+02", "0", "refers to a camera that is not registered"),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in EXAMPLE
    with pytest.raises(FileFormatError, match=words) as caught:
        read_bundler(written(tmp_path, EXAMPLE.replace(old, new)))
    assert "bundle.out" in str(caught.value)


def test_images_are_needed_for_their_sizes(tmp_path: Path) -> None:
    path = written(tmp_path)
    (tmp_path / "a.jpg").unlink()
    with pytest.raises(
        FileFormatError, match=r"it has no image sizes, and an image cannot be read: .*a\.jpg"
    ):
        read_bundler(path)
    with pytest.raises(FileFormatError, match=r"it has 1 images, but bundle\.out has 3 cameras"):
        read_bundler(written(tmp_path, names="a.jpg\n"))
    with pytest.raises(FileFormatError, match="does not name a file inside"):
        read_bundler(written(tmp_path, names=LIST.replace("./a", "/etc/a")))
    (tmp_path / "list.txt").unlink()
    with pytest.raises(FileFormatError, match=r"list\.txt: it does not exist"):
        read_bundler(path)
