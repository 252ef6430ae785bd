"""Cameras of files decide how much memory images take: those that are too large are refused, by name."""

import json

import numpy as np
import pytest

from epipole.cameras import Camera
from epipole.errors import ConfigError, FileFormatError
from epipole.fields.rays import rays_of_camera
from epipole.fields.splat.rasterizer import RenderOptions, view_of
from epipole.geometry import Rigid3
from epipole.pipelines.fields.cameras import render_views_of_model
from epipole.pipelines.fields.config import RenderConfig


def cameras_of(folder, width, height):
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    content = {"w": width, "h": height, "fl_x": 500.0, "fl_y": 500.0, "frames": [frame]}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder / "transforms.json"


def test_a_file_with_a_huge_camera_is_refused(tmp_path):
    source = cameras_of(tmp_path, 60000, 60000)
    with pytest.raises(
        FileFormatError, match=r"transforms\.json: the camera of 'a' is too large.*60000 x 60000"
    ):
        render_views_of_model(source, RenderConfig())
    (view,) = render_views_of_model(source, RenderConfig(width=64))
    assert (view.camera.width, view.camera.height) == (64, 64)
    with pytest.raises(FileFormatError, match="too large"):  # what is narrow may be long
        render_views_of_model(cameras_of(tmp_path, 1, 60000), RenderConfig(width=16384))


def test_no_field_is_rendered_at_such_a_size():
    camera = Camera("PINHOLE", 60000, 60000, [500.0, 500.0, 0.0, 0.0])
    for prepare in (rays_of_camera, lambda *given: view_of(*given, RenderOptions())):
        with pytest.raises(ConfigError, match="60000 x 60000"):
            prepare(camera, Rigid3.identity())
