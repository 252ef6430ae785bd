"""What `epipole.load` says of paths that it cannot read: the path, what is wrong, and what to do."""

from pathlib import Path

import pytest

import epipole
from epipole.errors import FileFormatError

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
