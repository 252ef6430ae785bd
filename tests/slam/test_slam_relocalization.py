"""Relocalization: what a lost frame is matched to, and that the work does not grow with the maps."""

import numpy as np
import pytest
from slam_rides import CAMERAS, ride

from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.loops import relocalization
from epipole.pipelines.slam.loops.relocalization import Relocalizer
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.slam import Slam

pytestmark = pytest.mark.usefixtures("unchecked", "few")
ALIKE, LATEST = 2, 1


@pytest.fixture
def few(monkeypatch):
    """The ride has few keyframes: match frames to fewer."""
    monkeypatch.setattr(relocalization, "ALIKE", ALIKE)
    monkeypatch.setattr(relocalization, "LATEST", LATEST)


@pytest.fixture(scope="module")
def known() -> SlamMap:
    """A map of more keyframes than a lost frame is matched to."""
    system = Slam(CAMERAS["stereo"])
    for frame in ride().frames("stereo")[:24]:
        system.track(frame)
    assert len(system.maps[0].keyframes) > ALIKE + LATEST
    return system.maps[0]


@pytest.fixture
def matched(monkeypatch):
    """(map, keyframe) of each call of `recognize`."""
    calls, real = [], relocalization.recognize

    def noted(view, model, number, camera, config):
        calls.append((model.number, number))
        return real(view, model, number, camera, config)

    monkeypatch.setattr(relocalization, "recognize", noted)
    return calls


def copy_of(model: SlamMap, number: int) -> SlamMap:
    out = SlamMap(number)
    out.__dict__ |= {name: value for name, value in vars(model).items() if name != "number"}
    return out


def searched(gray: np.ndarray, maps: list[SlamMap], finder: Relocalizer) -> list:
    return list(finder.search(gray, maps, maps[0]))


def test_a_known_image_is_found(known):
    finder = Relocalizer(CAMERAS["stereo"].camera, OdometryConfig())
    keyframe = known.keyframes[2]
    ((model, found),) = searched(keyframe.gray, [known], finder)
    assert model is known
    off = (found.cam_from_world @ keyframe.cam_from_world.inverse()).translation
    assert np.linalg.norm(off) < 0.01


def test_the_work_does_not_grow_with_the_maps(known, matched):
    maps = [copy_of(known, number) for number in range(5)]
    finder = Relocalizer(CAMERAS["stereo"].camera, OdometryConfig())
    found = searched(known.keyframes[0].gray, maps, finder)
    assert len(matched) <= ALIKE + LATEST and found
    newest = [call for call in matched if call[1] >= len(known.keyframes) - LATEST]
    assert {number for number, _ in newest} <= {0, *(number for number, _ in matched)}


def test_keyframes_that_failed_let_others_try(known, matched, rng):
    """A picture that the map does not have: after some frames, every keyframe has been tried."""
    finder = Relocalizer(CAMERAS["stereo"].camera, OdometryConfig())
    tiles = known.keyframes[0].gray.reshape(12, 20, 16, 20).swapaxes(1, 2).reshape(192, 20, 20)
    shuffled = rng.permutation(tiles).reshape(12, 16, 20, 20).swapaxes(1, 2).reshape(240, 320)
    first = None
    for _ in range(30):
        assert searched(shuffled, [known], finder) == []
        first = first or list(matched)
    assert {number for _, number in matched} == set(range(len(known.keyframes)))
    finder.clear()
    matched.clear()
    searched(shuffled, [known], finder)
    assert matched == first


def test_a_blank_image_is_matched_to_nothing(known, matched):
    finder = Relocalizer(CAMERAS["stereo"].camera, OdometryConfig())
    assert searched(np.full_like(known.keyframes[0].gray, 90), [known], finder) == [] and not matched
