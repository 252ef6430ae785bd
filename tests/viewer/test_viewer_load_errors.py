"""What `epipole.load` says of paths that it cannot read: the path, what is wrong, and what to do."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import epipole
from epipole.errors import FileFormatError
from epipole.io import write_bundler, write_chan, write_metashape, write_opensfm, write_realityscan
from io_models import mappable_model

FILES = {
    "notes.txt": b"hello\n",
    "frame.jpg": b"\xff\xd8\xff\xe0 and more",
    "all.zip": b"PK\x03\x04",
    "clip.mp4": b"\0\0\0\x18ftypisom",
    "list.json": b'{"a": 1}',
    "broken.json": b"{",
    "points.ply": b"x",
    "splat.spz": b"x",
    "depth.pfm": b"x",
    "map.npz": b"junk",
    "none.bin": b"",
    "table.csv": b"a,b\n1,2\n",
    "empty.out": b"",
    "image.xml": b"<svg></svg>",
    "bundle.out": b"# Bundle file v0.3\n1 0\n",
    "cameras.csv": b"#name,x,y,z\na.jpg,1,2,3\n",
    "shot.chan": b"1 2 3\n",
}


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("nothing", ["it does not exist", "check the name (the folder is "]),
        ("note.txt", ["it does not exist", "did you mean ", "notes.txt?"]),
        ("no/such/file.ply", ["it does not exist", "check the path: ", "/no is missing"]),
        ("notes.txt", ["cannot read this kind of file", "pass an output folder"]),
        ("frame.jpg", ["cannot read this kind of file", "it is a JPEG image", "pass an output folder"]),
        ("all.zip", ["it is a ZIP archive: unpack it", "pass an output folder"]),
        ("clip.mp4", ["it is a video", "pass an output folder"]),
        ("list.json", ["the list of frames is missing", "pass the file that lists the images"]),
        ("broken.json", ["not JSON", "check that this is the right file"]),
        ("points.ply", ["not a PLY file", "export or copy it again"]),
        ("splat.spz", ["not an SPZ file", "export or copy it again"]),
        ("depth.pfm", ["no valid PFM header", "export or copy it again"]),
        ("map.npz", ["not a map", "pass the output folder of an earlier `epipole slam`"]),
        ("none.bin", ["it is empty", "pass an output folder"]),
        ("table.csv", ["cannot read this kind of file", "pass an output folder"]),
        ("empty.out", ["it is empty", "pass an output folder"]),
        ("image.xml", ["not cameras of Metashape"]),
        ("bundle.out", ["it ends before the last of its 1 cameras"]),
        ("cameras.csv", ["it has no column heading"]),
        ("shot.chan", ["line 1: 8 finite numbers expected"]),
        ("folder", ["nothing in this folder can be read", "it is empty", "pass an output folder"]),
    ],
)
def test_a_path_that_cannot_be_read_is_explained(name: str, parts: list[str], tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for each, content in FILES.items():
        (tmp_path / each).write_bytes(content)
    with pytest.raises(FileFormatError) as error:
        epipole.load(tmp_path / name)
    said = str(error.value)
    assert said.startswith(f"{tmp_path / name}: ") and all(part in said for part in parts), said


def test_cameras_of_other_programs(tmp_path: Path) -> None:
    """By the content of the file; without a warning only where nothing is left out."""
    model = mappable_model(3, 12)
    model = replace(model, images=replace(model.images, name=("1.png", "2.png", "3.png")))
    (tmp_path / "images").mkdir()
    for name in model.images.name:
        Image.new("L", (640, 480)).save(tmp_path / "images" / name)
    write_metashape(model, tmp_path / "a.xml")
    write_opensfm(model, tmp_path / "reconstruction.json")
    write_realityscan(model, tmp_path / "a.csv")
    write_bundler(model, tmp_path / "a.out", "images")
    write_chan(model, tmp_path / "a.chan")
    for name in ("a.xml", "reconstruction.json", "a.csv", "a.out", "a.chan"):
        found = epipole.load(tmp_path / name)
        assert found.images.name == model.images.name, name
        np.testing.assert_allclose(
            found.cams_from_world().as_matrix(), model.cams_from_world().as_matrix(), atol=1e-9
        )
    # Names that are numbers do not make the table a trajectory.
    images = replace(model.images, name=("1", "2", "3"))
    write_realityscan(replace(model, images=images), tmp_path / "b.csv")
    for name in ("1", "2", "3"):
        Image.new("L", (640, 480)).save(tmp_path / name, "PNG")
    assert epipole.load(tmp_path / "b.csv").images.name == ("1", "2", "3")
