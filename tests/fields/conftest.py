"""A scene as a file, with its images."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a transforms.json and the images that it names."""
    from fields_scenes import camera, frames_of, views

    folder = tmp_path_factory.mktemp("source") / "scene"
    folder.mkdir()
    (folder / "transforms.json").write_text(json.dumps(camera() | {"frames": frames_of(views(), folder)}))
    return folder


@pytest.fixture(scope="module")
def small_hash() -> Iterator[None]:
    """Neural fields of this file cost a sixth."""
    from fields_trainers import small_neural_fields

    with small_neural_fields():
        yield
