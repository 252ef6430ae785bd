"""Every target of every command, and every kind of thing of the user's that may stand there already."""

from __future__ import annotations

import json
import os
import shutil
import socket
import stat
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from epipole.io import write_colmap_model
from epipole.io.colmap.database import DatabaseContents, write_database
from epipole.io.gaussians.files import write_gaussians
from io_models import mappable_model, write_gcp_list

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "fields"))
from fields_scenes import camera, frames_of, scene, views


@dataclass(frozen=True)
class Target:
    """One output of a command: its words, with OUT for the target, run in the folder of the inputs."""

    words: str
    name: str
    """Of the target."""
    source: str
    """An input that might be named as the target by mistake; empty if there is none."""
    is_file: bool = False


def folder(words: str, source: str) -> Target:
    return Target(words, "out", source)


def file(words: str, name: str, source: str) -> Target:
    return Target(words, name, source, is_file=True)


TARGETS: dict[str, tuple[Target, ...]] = {
    "reconstruct": (folder("reconstruct photos OUT", "photos"),),
    "localize": (folder("localize photos model OUT", "photos"),),
    "merge": (folder("merge model model2 OUT", "model"),),
    "georeference": (folder("georeference model OUT --gcp gcp_list.txt", "model"),),
    "surface": (folder("surface model OUT --until depth", "model"),),
    "slam": (folder("slam photos OUT --camera-params 60,60,32,24 --camera-model PINHOLE", "photos"),),
    "splat": (folder("splat scene OUT --steps 2", "scene"),),
    "nerf": (folder("nerf scene OUT --steps 2", "scene"),),
    "render": (
        file("render field.ply OUT --frames 2 --width 32 --height 24", "holiday.mp4", "field.ply"),
        folder("render field.ply OUT --frames 2 --width 32 --height 24", "field.ply"),
    ),
    "mesh": (file("mesh field.ply OUT --cameras scene --voxels 16 --width 32", "mesh.ply", "field.ply"),),
    "compare-fields": (folder("compare-fields scene OUT --steps 2", "scene"),),
    "stereo": (
        folder("stereo photos/a.png photos/b.png OUT", "photos"),
        folder("stereo left right OUT", "left"),
        folder("stereo OUT --workspace model --pair 000.jpg 001.jpg", "model"),
    ),
    "stereo-doctor": (),
    "calibrate": (folder("calibrate photos OUT --columns 9 --rows 6", "photos"),),
    "demo": (folder("demo OUT --num-views 2", ""),),
    "lesson": (Target("lesson --export OUT", "out", ""),),
    "view": (file("view field.ply --share OUT", "page.html", "field.ply"),),
    "evaluate": (),
    "undistort": (folder("undistort model --target OUT", "model"),),
    "convert": (
        *(
            folder(f"convert model OUT --format {form}", "model")
            for form in ("txt", "bin", "transforms", "bundler", "opensfm", "metashape", "kapture")
        ),
        file("convert model OUT --format ply", "scene.ply", "model/sparse/0/points3D.bin"),
        *(
            file("convert field.ply OUT", name, "field.ply")
            for name in ("a.ply", "a.compressed.ply", "a.spz", "a.sog", "a.splat")
        ),
    ),
    "completion": (),
    "version": (),
}
"""Of every command of the command line; a command without a row fails the tests."""
PAGE = "index.html"
"""The file of the lesson that may be the user's."""
OWN_FILES = ("notes.txt", PAGE, "report.html", "scene.ply")
"""In the user's folders."""


def make_inputs(root: Path) -> None:
    """Small inputs of all commands."""
    for name in ("photos/a.png", "photos/b.png", "left/a.png", "right/a.png"):
        (root / name).parent.mkdir(exist_ok=True)
        Image.fromarray(np.full((48, 64, 3), 90, np.uint8)).save(root / name)
    (root / "scene").mkdir()
    content = camera() | {"frames": frames_of(views(4), root / "scene")}
    (root / "scene" / "transforms.json").write_text(json.dumps(content))
    write_gaussians(root / "field.ply", scene())
    model = mappable_model()
    write_colmap_model(model, root / "model" / "sparse" / "0")
    counts = np.diff(model.images.keypoint_offsets)
    descriptors = [np.full((count, 128), 20, np.uint8) for count in counts]
    contents = DatabaseContents(model.cameras, model.rigs, model.frames, model.images, descriptors)
    write_database(root / "model" / "database.db", contents)
    write_gcp_list(root / "gcp_list.txt", model)
    (root / "model" / "images").mkdir()
    for row, name in enumerate(model.images.name):
        one = model.cameras[int(model.camera_of_image[row])]
        Image.fromarray(np.full((one.height, one.width, 3), 90, np.uint8)).save(
            root / "model" / "images" / name
        )

    shutil.copytree(root / "model", root / "model2")


def mine(path: Path) -> None:
    """A file of the user's in the format of its name."""
    path.write_bytes(
        {
            ".ply": b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n",
            ".mp4": b"\0\0\0\x18ftypisom\0\0\x02\0isomiso2mp41",
            ".html": b'<!doctype html>\n<meta name="generator" content="epipole">\n<title>My notes</title>',
            ".sog": b"PK\x03\x04 my archive",
            ".spz": b"\x1f\x8b\x08\0 my archive",
        }.get(path.suffix, b"mine")
    )


def elsewhere(path: Path) -> Path:
    path.with_name("elsewhere").mkdir()
    return path.with_name("elsewhere")


def linked_file(path: Path) -> None:
    real = elsewhere(path) / f"real{path.suffix}"
    mine(real)
    path.symlink_to(real)


def linked_folder(path: Path) -> None:
    real = elsewhere(path)
    for name in OWN_FILES:
        mine(real / name)
    path.symlink_to(real)


def hard_link(path: Path) -> None:
    real = elsewhere(path) / f"real{path.suffix}"
    mine(real)
    path.hardlink_to(real)


def own_folder(path: Path) -> None:
    path.mkdir()
    for name in OWN_FILES:
        mine(path / name)


def other_result(path: Path) -> None:
    """An output folder of another job, as its mark says."""
    own_folder(path)
    content = {"format": 3, "kind": "other", "source": ["/x"], "sketch": [], "version": "1", "finished": "1"}
    files = {"report": ["report.html"]}
    text = json.dumps({**content, "has_failed": False, "timings_s": {}, "files": files})
    (path / "epipole.json").write_text(text)


def read_only(path: Path) -> None:
    mine(path)
    path.chmod(0o444)


def bound_socket(path: Path) -> None:
    before = Path.cwd()
    os.chdir(path.parent)  # a socket's path is short
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name)
    finally:
        os.chdir(before)


EXISTING: dict[str, Callable[[Path], object]] = {
    "file": mine,
    "empty file": Path.touch,
    "read-only file": read_only,
    "link to a file": linked_file,
    "link to a folder": linked_folder,
    "link to nothing": lambda path: path.symlink_to(path.with_name("nothing")),
    "link to itself": lambda path: path.symlink_to(path),
    "link to a device": lambda path: path.symlink_to("/dev/null"),
    "hard link": hard_link,
    "folder": own_folder,
    "folder of another job": other_result,
    "pipe": os.mkfifo,
    "socket": bound_socket,
}
"""What may stand at the target."""
MAY_SUCCEED = ("link to nothing", "link to a device")
"""Of files, and of the lesson's folder: they are made where the link leads, and devices are written to."""


def snapshot(root: Path) -> dict[str, tuple[int, object]]:
    """Kind, rights and content of everything in a folder."""
    found: dict[str, tuple[int, object]] = {}
    for path in sorted(root.rglob("*")):
        mode = path.lstat().st_mode
        content: object = None
        if stat.S_ISLNK(mode):
            content = str(path.readlink())
        elif stat.S_ISREG(mode):
            content = path.read_bytes()
        found[path.relative_to(root).as_posix()] = mode, content
    return found
