"""Which images take part, with which masks and which known camera: said before the work begins."""

import json
import os
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from photographs import CAMERA, HEIGHT, WIDTH

from epipole import reconstruct
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, NoModelError
from epipole.geometry import Rigid3
from epipole.io.calibration.files import CalibrationFile, write_calibration
from epipole.pipelines.calibration.command import camera_options
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.sfm.photographs import read_image_set
from epipole.runs import ignore_progress

BLACK = np.zeros((HEIGHT, WIDTH), np.uint8)


def chosen(folder, **options):
    memory = folder.with_name(f"{folder.name}.contents.npz")
    return read_image_set(folder, ReconstructConfig(**options), memory, progress=ignore_progress)


@pytest.fixture
def rgbd(rendered, tmp_path):
    """Six color images with their depth, as RGB-D cameras store them."""
    folder = tmp_path / "rgbd"
    folder.mkdir()
    for n, path in enumerate(sorted(rendered.iterdir())):
        shutil.copy(path, folder / f"frame-{n:06d}.color.jpg")
        cv2.imwrite(str(folder / f"frame-{n:06d}.depth.png"), np.full((HEIGHT, WIDTH), 800 + n, np.uint16))
    return folder


def test_no_folder_of_masks_is_an_error_before_any_work(rendered, tmp_path):
    (tmp_path / "file").write_text("")
    for wrong, word in (("nosuch", "does not exist"), ("file", "is a file")):
        with pytest.raises(ConfigError, match=f"masks must be a folder of masks: .*{wrong} {word}"):
            reconstruct(rendered, tmp_path / "out", ReconstructConfig(masks=tmp_path / wrong))
    assert not (tmp_path / "out").exists()
    with pytest.raises(ConfigError, match="masks cannot be combined with database"):
        ReconstructConfig(masks=tmp_path, database=tmp_path / "database.db")


def test_masks_that_fit_no_picture_are_an_error_that_tells_the_names(rendered, tmp_path):
    masks = tmp_path / "masks"
    masks.mkdir()
    with pytest.raises(
        ConfigError, match=r"any of the 6 images: looked for view_00.jpg.png or view_00.png.*empty"
    ):
        reconstruct(rendered, tmp_path / "out", ReconstructConfig(masks=masks))
    cv2.imwrite(str(masks / "view_00_mask.png"), BLACK)
    with pytest.raises(ConfigError, match=r"there are view_00_mask.png"):
        reconstruct(rendered, tmp_path / "out", ReconstructConfig(masks=masks))
    assert not (tmp_path / "out").exists()


def test_masks_for_some_are_counted_and_said(few, tmp_path):
    masks = tmp_path / "masks"
    masks.mkdir()
    cv2.imwrite(str(masks / "view_03.png"), BLACK)
    result = reconstruct(few, tmp_path / "out", ReconstructConfig(masks=masks))
    assert any("masks for 1 of 4 images" in w and "view_00.jpg" in w for w in result.warnings)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["num_masked"] == 1 and any("masks for 1 of 4" in w for w in summary["warnings"])
    assert list(result.reasons) == ["view_03.jpg"]
    for path in few.iterdir():
        cv2.imwrite(str(masks / f"{path.name}.png"), BLACK + 255)
    everywhere = chosen(few, masks=masks)
    assert everywhere.num_masked == 4 and everywhere.notes == ()


def test_patterns_choose_pictures(rgbd):
    color = tuple(f"frame-{n:06d}.color.jpg" for n in range(6))
    assert chosen(rgbd, include=("*.color.jpg",)).names == color
    assert chosen(rgbd, exclude=("*.depth.png",)).names == color
    both = chosen(rgbd, include=("*0.color.jpg", "*1.color.jpg"), exclude=("*0.*",))
    assert both.names == color[1:2] and both.notes == ()
    assert len(chosen(rgbd, include=("*",))) == 12


def test_patterns_that_fit_nothing_name_what_is_there(rgbd, tmp_path):
    with pytest.raises(
        ConfigError, match=r"include '\*.tif' matches none .* frame-000000.color.jpg, frame-000000.depth"
    ):
        reconstruct(rgbd, tmp_path / "out", ReconstructConfig(include=("*.jpg", "*.tif")))
    with pytest.raises(
        ConfigError, match=r"exclude 'frame\*' leaves no image: there are frame-000000.color.jpg"
    ):
        reconstruct(rgbd, tmp_path / "out", ReconstructConfig(exclude=("frame*",)))
    assert not (tmp_path / "out").exists()
    assert "exclude '*.tif' matches none" in chosen(rgbd, exclude=("*.tif",)).notes[0]


def test_depth_beside_color_is_left_out_and_said(rgbd):
    found = chosen(rgbd)
    assert [name for name in found.names if "depth" in name] == [] and len(found) == 6
    assert "6 of 12 images are 16-bit gray PNGs" in found.notes[0] and "--include '*'" in found.notes[0]
    for path in rgbd.glob("*.color.jpg"):
        path.unlink()
    alone = chosen(rgbd)  # a camera may well give 16 bits
    assert len(alone) == 6 and alone.notes == ()


def test_patterns_are_settings(rgbd, tmp_path):
    result = reconstruct(rgbd, tmp_path / "out", ReconstructConfig(include=("*[012].color.jpg",)))
    assert result.summary["num_images"] == result.summary["num_registered"] == 3
    assert result.warnings == ()
    settings = json.loads((tmp_path / "out" / "config.json").read_text())
    assert settings["config"]["include"] == ["*[012].color.jpg"]


def test_a_calibration_makes_the_camera_known(rendered, tmp_path):
    path = tmp_path / "calibration.json"
    write_calibration(path, CalibrationFile((CAMERA,), Rigid3.identity(1)))
    given = chosen(rendered, calibration=path)
    words = camera_options(CAMERA).split()  # as `epipole calibrate` prints it
    assert words[0::2] == ["--camera-model", "--camera-params"]
    pasted = chosen(rendered, camera_model=words[1], camera_params=words[3])
    np.testing.assert_allclose(given.cameras.params, pasted.cameras.params, rtol=1e-7)
    np.testing.assert_array_equal(given.cameras[0].params, CAMERA.params)
    assert given.cameras.is_constant.all() and given.focal_sources == ("given by calibration.json",)
    assert not chosen(rendered, calibration=path, refine_known=True).cameras.is_constant.any()


def test_calibrations_that_do_not_fit(rendered, tmp_path):
    path = tmp_path / "calibration.json"
    write_calibration(path, CalibrationFile((CAMERA, CAMERA), Rigid3.identity(2)))
    with pytest.raises(ConfigError, match="has 2 cameras"):
        chosen(rendered, calibration=path)
    write_calibration(path, CalibrationFile((replace(CAMERA, width=100),), Rigid3.identity(1)))
    with pytest.raises(ConfigError, match="for images of 100x320, but these are 480x320"):
        chosen(rendered, calibration=path)
    with pytest.raises(ConfigError, match="calibration already has model and parameters"):
        ReconstructConfig(calibration=path, camera_params="1,2,3")


def test_pipes_are_never_opened(rendered, tmp_path):
    folder = tmp_path / "photographs"
    shutil.copytree(rendered, folder)
    os.mkfifo(folder / "view_99.jpg")
    found = chosen(folder)
    assert len(found) == 6 and "a pipe" in found.left_out["view_99.jpg"]
    assert "1 file left out: view_99.jpg" in found.notes[0]
    os.mkfifo(tmp_path / "film.mp4")
    with pytest.raises(NoModelError, match="a pipe or a device"):
        reconstruct(tmp_path / "film.mp4", tmp_path / "out")


def test_names_that_no_list_can_hold_are_left_out_and_named(rendered, tmp_path):
    folder = tmp_path / "photographs"
    folder.mkdir()
    names = ["line\nbreak.jpg", os.fsdecode(b"caf\xe9.jpg"), "n" * 251 + ".jpg", "b.jpg", "c.jpg"]
    for name, path in zip(names, sorted(rendered.iterdir())):
        shutil.copy(path, folder / name)
    result = reconstruct(folder, tmp_path / "out")
    assert set(result.reasons) == {r"line\nbreak.jpg", r"caf\udce9.jpg"}
    assert any(r"caf\udce9.jpg, line\nbreak.jpg" in warning for warning in result.warnings)
    assert result.summary["num_registered"] == 3
    assert (tmp_path / "out" / "images" / names[2]).is_file()
    for name in ("b.jpg", "c.jpg", names[2]):
        (folder / name).unlink()
    with pytest.raises(NoModelError, match="rename it"):
        reconstruct(folder, tmp_path / "none")


def test_a_fisheye_calibration_is_taken_as_it_is(rendered, tmp_path):
    camera = Camera(
        CameraModel.OPENCV_FISHEYE, WIDTH, HEIGHT, np.array([300.0, 301, 239, 160, 0.01, 0, 0, 0])
    )
    path = tmp_path / "calibration.json"
    write_calibration(path, CalibrationFile((camera,), Rigid3.identity(1)))
    assert chosen(rendered, calibration=path).cameras[0].model == CameraModel.OPENCV_FISHEYE


def test_masks_that_cover_everything_are_named_as_the_cause(few, tmp_path):
    masks = tmp_path / "masks"
    masks.mkdir()
    for path in few.iterdir():
        cv2.imwrite(str(masks / f"{path.name}.png"), BLACK)
    with pytest.raises(NoModelError, match=r"the masks leave 4 of 4 images fewer than .* inverted"):
        reconstruct(few, tmp_path / "out", masks=masks)
    for path in few.iterdir():
        cv2.imwrite(str(masks / f"{path.name}.png"), BLACK[:, 1:])
    with pytest.raises(NoModelError, match=r"can be used .*the mask is 479 x 320 but its image"):
        reconstruct(few, tmp_path / "out", masks=masks)


@pytest.mark.parametrize(
    ("cx", "cy", "words"),
    [
        (240, 160, ""),
        (255, 150, ""),
        (160, 240, "are cx and cy swapped"),
        (100, 160, "cropped or rectified"),
    ],
)
def test_a_principal_point_far_from_the_middle_is_remarked_on(rendered, cx, cy, words):
    notes = chosen(rendered, camera_params=f"400,400,{cx},{cy}").notes
    assert (words in " ".join(notes)) if words else notes == ()
