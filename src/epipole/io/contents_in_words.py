"""Descriptions of what a path contains, for error messages about unexpected input."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

from epipole.errors import FileFormatError
from epipole.io.files import read_json

MARK = "epipole.json"
"""Marker file in every output folder that names the command that wrote it."""
_MOST_LISTED = 1000
_HEADS = (
    (b"PK\x03\x04", "a ZIP archive: unpack it and pass the folder"),
    (b"\x1f\x8b", "a gzip archive: unpack it and pass its content"),
    (b"7z\xbc\xaf\x27\x1c", "a 7-Zip archive: unpack it and pass the folder"),
    (b"Rar!", "a RAR archive: unpack it and pass the folder"),
    (b"BZh", "a bzip2 archive: unpack it and pass its content"),
    (b"\xfd7zXZ", "an xz archive: unpack it and pass its content"),
    (b"\xff\xd8\xff", "a JPEG image"),
    (b"\x89PNG", "a PNG image"),
    (b"GIF8", "a GIF image"),
    (b"II*\x00", "a TIFF or RAW image"),
    (b"MM\x00*", "a TIFF or RAW image"),
    (b"%PDF", "a PDF document"),
    (b"glTF", "a glTF scene (.glb), which is not supported: export points or triangles as PLY"),
    (b"LASF", "a LAS point cloud, which is not supported: export it as PLY"),
    (b"ply", "a PLY file of points or triangles"),
    (b"SQLite format 3", "an SQLite database"),
)
_SUFFIXES = {
    ".gltf": "a glTF scene, which is not supported: export points or triangles as PLY",
    ".obj": "a Wavefront OBJ mesh, which is not supported: export it as PLY",
    ".stl": "an STL mesh, which is not supported: export it as PLY",
    ".fbx": "an FBX scene, which is not supported: export points or triangles as PLY",
    ".tar": "a tar archive: unpack it and pass the folder",
}
_IMAGES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".gif", ".bmp")


def what_it_is(path: Path) -> str:
    """A description `it is ...` or `it holds ...` of a path; empty if unknown."""
    try:
        if path.is_dir():
            return _of_folder(path)
        if not path.exists():
            return "it does not exist"
        if not path.is_file():
            return "it is neither a file nor a folder"
        with path.open("rb") as stream:
            head = stream.read(16)
    except OSError:
        return ""
    if not head:
        return "it is empty"
    named = next((words for start, words in _HEADS if head.startswith(start)), None)
    if head[4:8] == b"ftyp" and head[8:11] not in (b"hei", b"avi", b"mif"):
        named = "a video"
    named = named or _SUFFIXES.get(path.suffix.lower())
    return f"it is {named}" if named else ""


def with_what_it_is(problem: str, path: Path, advice: str = "") -> str:
    """Join a problem with a path, a description of its content if known, and advice."""
    return "; ".join(part for part in (problem, what_it_is(path), advice) if part)


def results_of(folder: Path) -> str:
    """The command that wrote an output folder; empty for other folders."""
    try:
        content = read_json(folder / MARK)
    except FileFormatError:
        return ""
    kind = content.get("kind") if isinstance(content, dict) else None
    return kind if isinstance(kind, str) and kind.replace("-", "").isalnum() else ""


def _of_folder(folder: Path) -> str:
    if command := results_of(folder):
        return f"it holds the results of `epipole {command}`"
    names = [path for path in islice(folder.iterdir(), _MOST_LISTED) if not path.name.startswith(".")]
    if not names:
        return "it is empty"
    images = [path for path in names if path.suffix.lower() in _IMAGES]
    return f"it holds images (such as {images[0].name})" if images else ""
