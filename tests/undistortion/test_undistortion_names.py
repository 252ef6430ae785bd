"""A model from anyone: its images' names are paths inside the output folder, or nothing is read or written."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from epipole.errors import FileFormatError, WorkspaceError
from epipole.io import write_colmap_model
from epipole.io.names import path_inside
from epipole.pipelines.sfm.page.scene import image_loader
from epipole.pipelines.stereo.run import stereo_of_model
from epipole.pipelines.undistortion.run import undistort
from io_models import mappable_model

OUTSIDE = ("../../photo.png", "{root}/photo.png", "a/../../../photo.png")


def image(path: Path) -> bytes:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((48, 64, 3), 90, np.uint8)).save(path)
    return path.read_bytes()


@pytest.fixture(params=OUTSIDE)
def name(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(request.param).format(root=tmp_path)


@pytest.fixture
def workspace(tmp_path: Path, name: str) -> Path:
    """An output folder whose model names an image of the user's."""
    model = mappable_model()
    names = (name, *model.images.name[1:])
    write_colmap_model(
        replace(model, images=replace(model.images, name=names)), tmp_path / "out" / "sparse" / "0"
    )
    for other in model.images.name[1:]:
        image(tmp_path / "out" / "images" / other)
    return tmp_path / "out"


def test_undistort_writes_inside_its_folder(tmp_path: Path, workspace: Path) -> None:
    before = image(tmp_path / "photo.png")
    with pytest.raises(FileFormatError, match="does not name a file inside"):
        undistort(workspace)
    assert (tmp_path / "photo.png").read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "photo.png"]
    assert not (workspace / "undistorted").exists()


def test_view_and_stereo_read_inside_the_folder(tmp_path: Path, workspace: Path, name: str) -> None:
    image(tmp_path / "photo.png")
    assert image_loader(workspace / "images")(name) is None
    with pytest.raises(FileFormatError, match="does not name a file inside"):
        stereo_of_model(workspace, name, mappable_model().images.name[1], tmp_path / "pair")


def test_links_among_the_results_are_not_followed(tmp_path: Path) -> None:
    """A folder that came with a link in the place of a result: the file it leads to stays as it is."""
    model = mappable_model()
    write_colmap_model(model, tmp_path / "out" / "sparse" / "0")
    for other in model.images.name:
        image(tmp_path / "out" / "images" / other)
    mine = image(tmp_path / "photo.png")
    done = undistort(tmp_path / "out") / "images" / model.images.name[0]
    done.unlink()
    done.symlink_to(tmp_path / "photo.png")
    with pytest.raises(WorkspaceError, match="is no longer a file"):
        undistort(tmp_path / "out")
    assert (tmp_path / "photo.png").read_bytes() == mine


def test_names_inside(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "away").symlink_to("/")
    (tmp_path / "circle").symlink_to("circle")
    assert path_inside(tmp_path, "sub/./a.jpg") == tmp_path / "sub" / "a.jpg"
    assert path_inside(tmp_path / "none", "a b/..c.jpg") == tmp_path / "none" / "a b" / "..c.jpg"
    for bad in (
        "",
        ".",
        "..",
        "/a",
        "sub/../../a",
        "away/etc/passwd",
        "a\0b",
        "sub/..",
        "\ud800.jpg",
        "x" * 256,
        "circle/a.jpg",
    ):
        with pytest.raises(FileFormatError, match="does not name a file inside"):
            path_inside(tmp_path, bad)
