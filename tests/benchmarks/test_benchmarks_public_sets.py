"""Scenes in the layouts of public benchmarks: found, linked, and scored as perfect if the model is the ground truth."""

from dataclasses import replace
from pathlib import Path

import pytest
from benchmarks.score import score_models
from benchmarks.tasks.public_sets import tasks_in
from PIL import Image

from epipole.io import write_bundler, write_colmap_model
from io_models import mappable_model


def draw(model, folder: Path) -> None:
    for row, name in enumerate(model.images.name):
        camera = model.cameras[int(model.camera_of_image[row])]
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (camera.width, camera.height)).save(folder / name)


def eth3d(model, scene: Path) -> None:
    draw(model, scene / "images" / "dslr_images_undistorted")
    write_colmap_model(inside(model, "dslr_images_undistorted"), scene / "dslr_calibration_undistorted")


def image_matching_challenge(model, scene: Path) -> None:
    draw(model, scene / "images")
    write_colmap_model(model, scene / "sfm", text=True)


def one_dsfm(model, scene: Path) -> None:
    draw(model, scene / "images")
    write_bundler(model, scene / "gt_bundle.out", "images")
    listed = (scene / "list.txt").read_text().splitlines()
    (scene / "list.txt").write_text("".join(f"{name} 0 500.0\n" for name in listed))


def inside(model, folder: str):
    """The model with image names in a folder."""
    return replace(
        model, images=replace(model.images, name=tuple(f"{folder}/{name}" for name in model.images.name))
    )


@pytest.mark.parametrize("write", [eth3d, image_matching_challenge, one_dsfm])
def test_a_model_that_is_the_ground_truth_has_no_error(tmp_path, write):
    model = mappable_model()
    write(model, tmp_path / "set" / "train" / "church")
    (tmp_path / "set" / "README.txt").write_text("downloaded")
    (task,) = tasks_in(tmp_path / "set", tmp_path / "work")
    assert task.name == "set_train_church" and len(task.image_names) == len(model.images.name)
    assert all((task.images / name).is_file() for name in task.image_names)
    named = inside(model, "dslr_images_undistorted") if write is eth3d else model
    assert set(task.image_names) == set(named.images.name)
    write_colmap_model(named, tmp_path / "out" / "0")
    score = score_models(task, tmp_path / "out")
    assert score["registered"] == model.is_registered().sum()
    assert score["auc_1"] > 0.99 and score["position_max"] < 1e-6


def test_images_that_only_the_published_model_has_are_not_missing(tmp_path):
    model = mappable_model()
    image_matching_challenge(model, tmp_path / "church")
    gone = model.images.name[0]
    (tmp_path / "church" / "images" / gone).unlink()
    (task,) = tasks_in(tmp_path, tmp_path / "work")
    rest = replace(model, images=replace(model.images, name=("elsewhere.jpg", *model.images.name[1:])))
    write_colmap_model(rest, tmp_path / "out" / "0")
    assert gone not in task.image_names and score_models(task, tmp_path / "out")["auc_1"] > 0.99


def test_a_folder_without_scenes_is_named(tmp_path):
    (tmp_path / "images").mkdir()
    with pytest.raises(FileNotFoundError, match=r"ETH3D.*Image Matching Challenge.*1DSfM"):
        tasks_in(tmp_path, tmp_path / "work")
