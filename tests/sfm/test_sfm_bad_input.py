"""Bad input gets clear words, the rest is reconstructed, and what was made stays."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from photographs import CAMERA, neighboring_views, render_to
from PIL import Image

from epipole.api import reconstruct
from epipole.config import RansacConfig
from epipole.errors import ConfigError, FileFormatError, NoModelError, WorkspaceError
from epipole.geometry import Rigid3, Rotation3
from epipole.pipelines.sfm.config import MapperConfig, PairingConfig, ReconstructConfig
from whole import IS_WHOLE, in_whole_run

pytestmark = pytest.mark.usefixtures("unchecked")


def copied(rendered: Path, folder: Path, count: int = 6) -> Path:
    folder.mkdir()
    for path in sorted(rendered.iterdir())[:count]:
        shutil.copy2(path, folder / path.name)
    return folder


def test_empty_folder_and_no_folder(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "notes.txt").write_text("no image")
    with pytest.raises(NoModelError, match="holds no photographs"):
        reconstruct(tmp_path / "empty", tmp_path / "out")
    with pytest.raises(NoModelError, match="does not exist"):
        reconstruct(tmp_path / "nowhere", tmp_path / "out2")


def test_a_mistyped_folder_leaves_the_output_free(rendered, tmp_path):
    (tmp_path / "empty").mkdir()
    for wrong in ("nowhere", "empty"):
        with pytest.raises(NoModelError):
            reconstruct(tmp_path / wrong, tmp_path / "out")
    with pytest.raises(NoModelError, match="one image"):  # the output is not the wrong folder's
        reconstruct(copied(rendered, tmp_path / "right", 1), tmp_path / "out")


KILLED_WHILE_WRITING = """
import os, signal, sys
from epipole.io.atomic import atomic_write

with atomic_write(sys.argv[1]) as aside:
    aside.write_bytes(b"half an image")
    os.kill(os.getpid(), signal.SIGKILL)
"""


@in_whole_run
@pytest.mark.parametrize("is_rotated", [False] + IS_WHOLE * [True])
def test_an_older_picture_replaces_the_newer_one(rendered, tmp_path, is_rotated):
    """Which file is older says nothing: `cp -p`, an unpacked archive or a backup bring old dates."""
    folder = copied(rendered, tmp_path / "photographs", 3)
    changed = folder / "view_02.jpg"
    if is_rotated:
        exif = Image.Exif()
        exif[0x0112] = 3
        Image.open(changed).rotate(180).save(changed, quality=97, exif=exif)
    before = reconstruct(folder, tmp_path / "out").model.images.keypoints_of(2)
    copy = tmp_path / "out" / "images" / "view_02.jpg"
    first = copy.read_bytes()
    changed.unlink()
    shutil.copy(rendered / "view_04.jpg", changed)
    os.utime(changed, (1e9, 1e9))
    left = [sys.executable, "-c", KILLED_WHILE_WRITING, str(copy)]
    assert subprocess.run(left, check=False).returncode == -signal.SIGKILL
    assert len(list(copy.parent.glob(".*.part.jpg"))) == 1
    (copy.parent / ".mine.jpg").write_bytes(b"and somebody else this")
    after = reconstruct(folder, tmp_path / "out").model.images.keypoints_of(2)
    assert copy.read_bytes() == changed.read_bytes() != first
    assert before.shape != after.shape or not np.array_equal(before, after)
    assert [p.name for p in copy.parent.glob(".*")] == [".mine.jpg"]
    state = copy.stat()
    reconstruct(folder, tmp_path / "out")
    assert copy.stat().st_ino == state.st_ino and copy.stat().st_mtime_ns == state.st_mtime_ns


@in_whole_run
def test_avif_ends_with_a_model(few, tmp_path):
    folder = tmp_path / "photographs"
    folder.mkdir()
    for path in sorted(few.iterdir()):
        with Image.open(path) as image:
            image.save(folder / f"{path.stem}.avif", quality=90)
    result = reconstruct(folder, tmp_path / "out")
    assert result.summary["num_registered"] == 4
    assert (tmp_path / "out" / "images" / "view_00.avif").is_file()


def test_one_image(rendered, tmp_path):
    with pytest.raises(NoModelError, match="one image cannot give depth"):
        reconstruct(copied(rendered, tmp_path / "one", 1), tmp_path / "out")


def test_tiny_and_blank_images(tmp_path):
    (tmp_path / "tiny").mkdir()
    cv2.imwrite(str(tmp_path / "tiny" / "a.png"), np.zeros((3, 3, 3), np.uint8))
    with pytest.raises(NoModelError, match="too small"):
        reconstruct(tmp_path / "tiny", tmp_path / "out")
    (tmp_path / "blank").mkdir()
    for n in range(3):
        cv2.imwrite(str(tmp_path / "blank" / f"{n}.png"), np.full((240, 320, 3), 90 + n, np.uint8))
    with pytest.raises(NoModelError, match="share enough features"):
        reconstruct(tmp_path / "blank", tmp_path / "out2")


def test_two_images_without_overlap(rendered, tmp_path):
    folder = copied(rendered, tmp_path / "two", 1)
    random = np.random.default_rng(0)
    noise = cv2.resize(random.integers(0, 255, (80, 120, 3)).astype(np.uint8), (480, 320))
    cv2.imwrite(str(folder / "other.png"), noise)
    with pytest.raises(NoModelError, match="share enough features"):
        reconstruct(folder, tmp_path / "out")


def test_the_same_picture_twice(rendered, tmp_path):
    folder = copied(rendered, tmp_path / "same", 1)
    shutil.copy(next(folder.iterdir()), folder / "again.jpg")
    with pytest.raises(NoModelError, match="the same"):
        reconstruct(folder, tmp_path / "out")


def test_pure_rotation_gives_no_depth(tmp_path):
    base = neighboring_views(1)
    rotations = Rotation3.exp(np.array([[0, 0.12 * k, 0.01 * k] for k in range(3)])).matrix
    views = Rigid3(rotations @ base.rotation, (rotations @ base.translation[..., None])[..., 0])
    render_to(tmp_path / "turn", views)
    with pytest.raises(NoModelError, match="only rotated"):
        reconstruct(tmp_path / "turn", tmp_path / "out")
    assert (tmp_path / "out" / "database.db").is_file()


def test_damaged_pictures_are_named_and_the_rest_is_reconstructed(rendered, tmp_path):
    folder = copied(rendered, tmp_path / "mixed", 4)
    whole = (folder / "view_00.jpg").read_bytes()
    (folder / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    (folder / "text.jpg").write_text("this is no image")
    cv2.imwrite(str(folder / "blank.png"), np.full((320, 480, 3), 128, np.uint8))
    result = reconstruct(folder, tmp_path / "out")
    assert result.summary["num_registered"] == 4
    assert set(result.reasons) == {"cut.jpg", "text.jpg", "blank.png"}
    assert "no features" in result.reasons["blank.png"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert all(name in page for name in result.reasons)


def test_outputs_that_cannot_be_used(rendered, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(WorkspaceError, match="is a file"):
        reconstruct(rendered, tmp_path / "file")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "precious.txt").write_text("mine")
    with pytest.raises(WorkspaceError, match="not written by epipole"):
        reconstruct(rendered, tmp_path / "other")
    assert [p.name for p in (tmp_path / "other").iterdir()] == ["precious.txt"]
    (tmp_path / "held").mkdir()
    mark = {
        "format": 3,
        "kind": "reconstruct",
        "source": ["/elsewhere"],
        "sketch": [],
        "finished": "",
        "files": {"model": ["a.bin"]},
    }
    (tmp_path / "held" / "epipole.json").write_text(json.dumps(mark))
    with pytest.raises(WorkspaceError, match="contains the results of `epipole reconstruct` for /elsewhere"):
        reconstruct(rendered, tmp_path / "held")


@pytest.mark.parametrize(
    ("params", "word"),
    [
        ("1,2,3", "takes 4 parameters"),
        ("400,240,160,0,9", "takes 4 parameters"),
        ("nan,240,160,0", "finite"),
        ("1e999,240,160,0", "finite"),
        ("-5,240,160,0", "must be positive"),
        ("1e308,240,160,0", "f = 1e.308 is not plausible for a camera of 480x320"),
        ("1e-3,240,160,0", "f = 0.001 is not plausible"),
        ("400,1e300,160,0", "cx = 1e.300 is not plausible"),
        ("400,240,160,1e300", "k = 1e.300 is not plausible"),
    ],
)
def test_wrong_camera_params(rendered, tmp_path, params, word):
    with pytest.raises(ConfigError, match=word):
        reconstruct(
            rendered,
            tmp_path / "out",
            ReconstructConfig(camera_model="SIMPLE_RADIAL", camera_params=params),
        )
    assert not (tmp_path / "out").exists()


def test_options_that_make_no_sense(rendered, tmp_path):
    two = copied(rendered, tmp_path / "photographs", 2)
    with pytest.raises(ConfigError, match="numbers"):
        ReconstructConfig(camera_params="a,b")
    with pytest.raises(ConfigError, match="seed must not be negative"):
        MapperConfig(seed=-1)
    with pytest.raises(ConfigError, match="seed must be from 0 to"):
        MapperConfig(seed=2**40)
    with pytest.raises(ConfigError, match="seed must not be negative"):
        RansacConfig(seed=-1)
    for name in ("pairs", "database", "calibration"):
        with pytest.raises(FileFormatError, match=f"it does not exist .{name}"):
            reconstruct(two, tmp_path / "out", ReconstructConfig(**{name: tmp_path / "nosuch"}))
    with pytest.raises(ConfigError, match="unknown camera model"):
        reconstruct(two, tmp_path / "out", ReconstructConfig(camera_model="LENS"))
    with pytest.raises(ConfigError, match="GPS"):
        reconstruct(two, tmp_path / "out", ReconstructConfig(pairing=PairingConfig(method="spatial")))
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("view_00.jpg nothing.jpg\n")
    with pytest.raises(FileFormatError, match="line 1"):
        reconstruct(two, tmp_path / "out", ReconstructConfig(pairs=pairs))


def test_masks_remove_features(few, tmp_path):
    masks = tmp_path / "masks"
    masks.mkdir()
    keep = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    keep[:, : CAMERA.width // 3] = 0
    for path in few.iterdir():
        cv2.imwrite(str(masks / f"{path.name}.png"), keep)
    result = reconstruct(few, tmp_path / "out", ReconstructConfig(masks=masks))
    assert result.summary["num_registered"] == 4
    assert result.model.images.keypoints_px[:, 0].min() >= CAMERA.width // 3 - 1


KILLED_TWICE = """
import os, signal, sys
import epipole.api as api
import epipole.pipelines.sfm.results as results

def die(*_):
    os.kill(os.getpid(), signal.SIGKILL)

def progress(event):
    if event.stage == stage and 2 * event.done >= event.total:
        die()

for stage in ("match", "write"):
    child = os.fork()
    if child == 0:
        if stage == "write":
            results.write_scene_ply = die  # the model is written, the rest is not
        api.reconstruct(*sys.argv[1:], progress=progress)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL, stage
"""


def test_killed_in_two_stages_it_continues_to_the_same_model(rendered, tmp_path):
    """Kills at any file operation of any stage: `tests/fuzz/interruptions.py`."""
    images = copied(rendered, tmp_path / "photographs", 3)
    reconstruct(images, tmp_path / "reference")
    out = tmp_path / "killed"
    command = [sys.executable, "-c", KILLED_TWICE, str(images), str(out)]
    done = subprocess.run(command, check=False, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
    assert reconstruct(images, out).summary["num_registered"] == 3
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        a, b = (tmp_path / run / "sparse" / "0" / name for run in ("reference", "killed"))
        assert a.read_bytes() == b.read_bytes(), name


WITH_LITTLE_ROOM = """
import resource, signal, sys
from epipole.api import reconstruct
from epipole.config import RansacConfig
from epipole.errors import WorkspaceError

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
images, *outs = sys.argv[1:]
for out in outs:
    room = int(out.rpartition("_")[2])
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))
    try:
        reconstruct(images, out)
    except WorkspaceError as error:
        print(room, error)
"""


@in_whole_run
@pytest.mark.skipif(sys.platform == "win32", reason="file size limits are POSIX")
def test_where_files_cannot_grow_the_run_says_so_and_goes_on_later(rendered, tmp_path):
    """A full disk as a program sees it: a write in the middle of a file fails. The limits stop detection and the database."""
    images = copied(rendered, tmp_path / "photographs", 3)
    outs = {room: tmp_path / f"out_{room}" for room in (1_000, 600_000)}
    command = [sys.executable, "-c", WITH_LITTLE_ROOM, str(images), *map(str, outs.values())]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    for room, out in outs.items():
        assert re.search(f"^{room} .*cannot write", done.stdout, re.MULTILINE), (room, done.stdout)
        assert not [p for p in out.rglob("*") if p.name.endswith(".tmp") or ".part" in p.name], room
        assert bool(list((out / "work").rglob("*/*.npz"))) == (room > 1_000), "not the stage that was meant"
        assert reconstruct(images, out).summary["num_registered"] == 3, room
