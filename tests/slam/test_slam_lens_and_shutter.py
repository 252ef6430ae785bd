"""A rolling shutter does not hide a wrong lens: both are said, and the lens is checked with the shutter taken out."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from epipole.cameras import Camera
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.frames import SlamCamera
from epipole.pipelines.slam.output import results
from epipole.pipelines.slam.output.camera_check import CameraCheck
from epipole.pipelines.slam.shutter import check as shutter_check
from epipole.pipelines.slam.shutter.check import ReadoutFound, with_readout

pytestmark = pytest.mark.usefixtures("unchecked_module")


def keyframe(n):
    return SimpleNamespace(point=np.arange(n), shift_px=np.zeros((n, 3)))


@pytest.fixture
def mapper():
    return SimpleNamespace(
        map=SimpleNamespace(keyframes=[keyframe(3), keyframe(0)], right_shift_px=0.0),
        sensor=SimpleNamespace(camera=None),
    )


def test_shifts_are_there_inside_and_gone_after(mapper, monkeypatch):
    monkeypatch.setattr(shutter_check, "motions_at", lambda path, keyframes: [None] * len(keyframes))
    monkeypatch.setattr(shutter_check, "shutter_shifts", lambda *given: np.full((3, 3), given[-1].readout_s))
    (first, empty), path = mapper.map.keyframes, None
    with with_readout(mapper, path, 0.0):
        assert not first.shift_px.any()
    with pytest.raises(ValueError, match="stop"), with_readout(mapper, path, 0.02):
        assert (first.shift_px == 0.02).all() and not len(empty.shift_px)
        raise ValueError("stop")
    assert not first.shift_px.any()


@pytest.mark.parametrize("has_shutter", [True, False])
@pytest.mark.parametrize(("given_px", "is_wrong"), [(420.0, True), (525.0, False)])
def test_both_are_said(mapper, monkeypatch, has_shutter, given_px, is_wrong):
    found, readouts = ReadoutFound(0.02, 0.3) if has_shutter else None, []
    lens = CameraCheck(given_px, 507.0, 8.0, 0.0, 0.03, 0.6, abs(507.0 - given_px) / 8.0)
    monkeypatch.setattr(results, "find_readout", lambda *_: found)
    monkeypatch.setattr(results, "check_camera", lambda *_: lens)
    monkeypatch.setattr(
        results, "with_readout", lambda *given: (readouts.append(given[-1]), nullcontext())[1]
    )
    for name in ("warnings", "poor_images", "moving_things"):
        monkeypatch.setattr(results, name, lambda *_: [])
    pinhole = Camera("PINHOLE", 640, 480, [given_px, given_px, 319.5, 239.5])
    camera = SlamCamera(pinhole)
    system = SimpleNamespace(
        maps=[mapper.map],
        camera=camera,
        config=SlamConfig(),
        local_mapper=lambda _: mapper,
        trajectory=lambda: None,
    )
    run = SimpleNamespace(stage=lambda _: nullcontext(), warnings=[])
    facts = results._checked(system, [], None, run)
    assert readouts == [0.02 if has_shutter else 0.0]
    assert any("20.0 ms" in words for words in run.warnings) == has_shutter
    wrong = [words for words in run.warnings if "given focal length" in words]
    assert len(wrong) == is_wrong
    if is_wrong:
        assert "420 px" in wrong[0] and "507 +- 8 px" in wrong[0]
    assert facts["camera_check"]["given_focal_px"] == given_px and facts["fraction_without_ray"] == 0.0
