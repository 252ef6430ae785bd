"""Splits and masks that a transforms.json names are used; what asks otherwise goes before, and is said."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from epipole.errors import ConfigError, FileFormatError
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.images import FieldImages, gather_field_images

OPTIONS = FieldOptions(test_every=2)


def scene(folder: Path, own: dict[str, Any] | None = None, of_frames: dict[int, Any] | None = None) -> Path:
    (folder / "images").mkdir(exist_ok=True)
    frames = []
    for k in range(6):
        Image.new("RGB", (32, 24), (20 * k, 90, 30)).save(folder / "images" / f"{k}.png")
        matrix = np.eye(4)
        matrix[0, 3] = k
        frame = {"file_path": f"images/{k}.png", "transform_matrix": matrix.tolist()}
        frames.append(frame | (of_frames or {}).get(k, {}))
    values = {"w": 32, "h": 24, "fl_x": 30.0, "frames": frames} | (own or {})
    (folder / "transforms.json").write_text(json.dumps(values))
    return folder


def names(*numbers: int) -> list[str]:
    return [f"images/{k}.png" for k in numbers]


def split(found: FieldImages) -> tuple[list[str], list[str]]:
    return [view.name for view in found.train], [view.name for view in found.test]


@pytest.mark.parametrize(
    ("own", "train", "test", "problem"),
    [
        ({"train_filenames": names(0, 1, 2), "test_filenames": names(3, 4, 5)}, (0, 1, 2), (3, 4, 5), None),
        ({"test_filenames": names(5)}, (0, 1, 2, 3, 4), (5,), None),
        ({"train_filenames": names(0, 1, 2, 3), "val_filenames": names(4, 5)}, (0, 1, 2, 3), (4, 5), None),
        (
            {key: names(*k) for key, k in (("train_filenames", (0, 1, 2)), ("val_filenames", (3,)), ("test_filenames", (4,)))},
            (0, 1, 2), (4,), "2 images are in neither the training nor the test split (images/3.png)",
        ),
        ({"train_filenames": names(0, 1, 2), "test_filenames": names(2, 3, 4, 5)}, (0, 1, 2), (2, 3, 4, 5), "1 images are both in the training and the test split"),
        ({"train_filenames": names(0, 2)}, (0, 2), (), "4 images are in neither the training nor the test split"),
    ],
)  # fmt: skip
def test_splits_of_the_file_are_used(tmp_path, own, train, test, problem) -> None:
    found = gather_field_images(scene(tmp_path, own), OPTIONS)
    assert split(found) == (names(*train), names(*test))
    assert [problem in text for text in found.problems] == [True] if problem else found.problems == []


def test_images_asked_for_go_before_the_splits_of_the_file(tmp_path) -> None:
    folder = scene(tmp_path, {"train_filenames": names(0, 1, 2), "test_filenames": names(3)})
    found = gather_field_images(folder, replace(OPTIONS, test="images/0.png"))
    assert split(found) == (names(1, 2, 3, 4, 5), names(0))
    assert ["splits of the file are ignored" in text for text in found.problems] == [True]
    with pytest.raises(ConfigError, match="nowhere"):
        gather_field_images(folder, replace(OPTIONS, test="nowhere.png"))
    assert split(gather_field_images(scene(tmp_path), OPTIONS))[1] == names(0, 2, 4)


def test_masks_that_the_file_names_are_used(tmp_path) -> None:
    mask = np.full((24, 32), 255, np.uint8)
    mask[:, :10] = 0
    folder = scene(
        tmp_path, of_frames={2: {"mask_path": "masks/two.png"}, 3: {"mask_path": "masks/none.png"}}
    )
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks" / "two.png")
    found = gather_field_images(folder, replace(OPTIONS, test_every=0))
    used = {view.name: view.used_mask for view in found.train}
    np.testing.assert_array_equal(used["images/2.png"], mask > 0)
    assert used["images/0.png"] is None and "images/3.png" not in used
    assert len(found.problems) == 1 and "masks/none.png" in found.problems[0]


def test_a_folder_of_masks_goes_before_those_of_the_file(tmp_path) -> None:
    folder = scene(tmp_path, {"mask_path": "masks/all.png"})
    (tmp_path / "mine" / "images").mkdir(parents=True)
    Image.new("L", (32, 24), 255).save(tmp_path / "mine" / "images" / "1.png")
    found = gather_field_images(folder, replace(OPTIONS, masks=tmp_path / "mine"))
    assert [view.name for view in [*found.train, *found.test] if view.used_mask is not None] == names(1)
    assert ["masks in the file are ignored" in text for text in found.problems] == [True]
    scene(tmp_path, {"mask_path": "../all.png"})
    with pytest.raises(FileFormatError, match="does not name a file inside"):
        gather_field_images(folder, OPTIONS)


def test_what_the_file_holds_besides_is_a_warning_of_the_job(tmp_path) -> None:
    pose = np.full((4, 4), np.nan).tolist()
    folder = scene(tmp_path, {"weather": "sunny"}, {4: {"transform_matrix": pose}})
    found = gather_field_images(folder, OPTIONS)
    assert len(found.train) + len(found.test) == 5
    words = "\n".join(found.problems)
    assert "unknown keys are ignored: weather" in words and "skipped frame 4 (images/4.png)" in words
