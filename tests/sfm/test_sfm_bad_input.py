"""Bad input gets clear words, the rest is reconstructed, and what was made stays."""

import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from photographs import CAMERA, neighbouring_views, render_to

from epipole.api import reconstruct
from epipole.config import PairingConfig, ReconstructConfig
from epipole.errors import ConfigError, FileFormatError, NoModelError, WorkspaceError
from epipole.geometry import Rigid3, Rotation3


def copied(rendered: Path, folder: Path, count: int = 6) -> Path:
    folder.mkdir()
    for path in sorted(rendered.iterdir())[:count]:
        shutil.copy2(path, folder / path.name)
    return folder


def test_empty_folder_and_no_folder(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "notes.txt").write_text("no picture")
    with pytest.raises(NoModelError, match="holds no photographs"):
        reconstruct(tmp_path / "empty", tmp_path / "out")
    with pytest.raises(NoModelError, match="does not exist"):
        reconstruct(tmp_path / "nowhere", tmp_path / "out2")


def test_one_image(rendered, tmp_path):
    with pytest.raises(NoModelError, match="one picture cannot give depth"):
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
    base = neighbouring_views(1)
    turns = Rotation3.exp(np.array([[0, 0.12 * k, 0.01 * k] for k in range(3)])).matrix
    views = Rigid3(turns @ base.rotation, (turns @ base.translation[..., None])[..., 0])
    render_to(tmp_path / "turn", views)
    with pytest.raises(NoModelError, match="only turned"):
        reconstruct(tmp_path / "turn", tmp_path / "out")
    assert (tmp_path / "out" / "database.db").is_file()


def test_damaged_pictures_are_named_and_the_rest_is_reconstructed(rendered, tmp_path):
    folder = copied(rendered, tmp_path / "mixed")
    whole = (folder / "view_00.jpg").read_bytes()
    (folder / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    (folder / "text.jpg").write_text("this is no picture")
    cv2.imwrite(str(folder / "blank.png"), np.full((320, 480, 3), 128, np.uint8))
    result = reconstruct(folder, tmp_path / "out")
    assert result.summary["num_registered"] == 6
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
    with pytest.raises(WorkspaceError, match="not made by epipole"):
        reconstruct(rendered, tmp_path / "other")
    assert [p.name for p in (tmp_path / "other").iterdir()] == ["precious.txt"]
    (tmp_path / "held").mkdir()
    (tmp_path / "held" / "epipole.json").write_text('{"format": 1, "source": "/elsewhere"}')
    with pytest.raises(WorkspaceError, match="holds the reconstruction of /elsewhere"):
        reconstruct(rendered, tmp_path / "held")


@pytest.mark.parametrize("params", ["1,2,3", "400,240,160,0,9", "nan,240,160,0", "-5,240,160,0"])
def test_wrong_camera_params(rendered, tmp_path, params):
    config = ReconstructConfig(camera_model="SIMPLE_RADIAL", camera_params=params)
    with pytest.raises(ConfigError):
        reconstruct(rendered, tmp_path / "out", config)


def test_options_that_make_no_sense(rendered, tmp_path):
    with pytest.raises(ConfigError, match="numbers"):
        ReconstructConfig(camera_params="a,b")
    with pytest.raises(ConfigError, match="unknown camera model"):
        reconstruct(rendered, tmp_path / "out", ReconstructConfig(camera_model="LENS"))
    with pytest.raises(ConfigError, match="GPS"):
        reconstruct(rendered, tmp_path / "out2", ReconstructConfig(pairing=PairingConfig(method="spatial")))
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("view_00.jpg nothing.jpg\n")
    with pytest.raises(FileFormatError, match="line 1"):
        reconstruct(rendered, tmp_path / "out3", ReconstructConfig(pairs=pairs))


def test_masks_remove_features(rendered, tmp_path):
    masks = tmp_path / "masks"
    masks.mkdir()
    keep = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    keep[:, : CAMERA.width // 3] = 0
    for path in rendered.iterdir():
        cv2.imwrite(str(masks / f"{path.name}.png"), keep)
    result = reconstruct(rendered, tmp_path / "out", ReconstructConfig(masks=masks))
    assert result.summary["num_registered"] == 6
    assert result.model.images.keypoints_px[:, 0].min() >= CAMERA.width // 3 - 1


def test_killed_at_any_time_it_goes_on_to_the_same_model(rendered, tmp_path):
    reference = reconstruct(rendered, tmp_path / "reference")
    command = [
        sys.executable,
        "-m",
        "epipole.cli.main",
        "reconstruct",
        str(rendered),
        str(tmp_path / "killed"),
    ]
    for seconds in (1.2, 1.8, 2.6):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(seconds)
        process.send_signal(signal.SIGKILL)
        process.wait()
    subprocess.run(command, check=True, capture_output=True)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        a, b = (tmp_path / run / "sparse" / "0" / name for run in ("reference", "killed"))
        assert a.read_bytes() == b.read_bytes(), name
    assert reference.summary["num_registered"] == 6
