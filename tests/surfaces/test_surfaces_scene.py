"""The viewer's scene of a surface: its axes, its unit, and the rigs of its cameras."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from epipole.io.meshes.mesh_ply import write_mesh_ply
from epipole.pipelines.surfaces import scene as surface_scene
from epipole.report.space_model import RIGS, rig_curve
from epipole.runs.model_source import ModelSource
from epipole.scene import Georeference
from io_models import small_model


@pytest.mark.parametrize("is_on_earth", [True, False])
def test_a_surface_has_the_axes_and_rigs_of_its_model(
    is_on_earth: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    write_mesh_ply(tmp_path / surface_scene.MESH, corners, [[0, 1, 2]], np.full((3, 3), 90, np.uint8))
    model = small_model()
    if is_on_earth:
        model = replace(model, georeference=Georeference(47.0, 8.0, 400.0))
    monkeypatch.setattr(surface_scene, "_model_source", lambda path: ModelSource(model, tmp_path))
    found = surface_scene.scene(tmp_path)
    assert (found.is_enu, found.unit) == (is_on_earth, "m" if is_on_earth else "")
    (rig,) = found.curves
    assert rig.name == RIGS and not rig.is_shown  # like the cameras, below a mesh
    np.testing.assert_array_equal(rig.segments_in_world, rig_curve(model).segments_in_world)
    registered = model.is_registered()
    of_frame = np.bincount(model.images.frame[registered])
    assert len(rig.segments_in_world) == (of_frame - 1)[of_frame > 0].sum() > 0
