"""Laws of the map: points become one, maps become one, another world, a path that goes along; and drift that is spread."""

from itertools import pairwise

import numpy as np
import pytest
from slam_rides import CAMERA, MONO, RGBD, ride, tracked

from epipole.geometry import Rigid3, Similarity3
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.loops import closing as loop_closing
from epipole.pipelines.slam.loops.closing import LoopCloser, LoopConstraint
from epipole.pipelines.slam.loops.correction import correct_drift
from epipole.pipelines.slam.loops.recognition import Recognition, View
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.map.trajectory import Path

GRAY = np.zeros((240, 320), np.uint8)


def some_map(rng, numbers, num_points=60, seen=25) -> SlamMap:
    """Keyframes that look about the same way, and points before them, some without a place."""
    model = SlamMap()
    xyz = rng.uniform([-2, -1.5, 4], [2, 1.5, 8], (num_points, 3))
    xyz[rng.random(num_points) < 0.1] = np.nan
    anchor = rng.integers(0, len(numbers), num_points)
    model.add_points(xyz, rng.uniform(0, 240, (num_points, 2)), anchor)
    model.num_agreed[:] = rng.integers(0, 9, num_points)
    for number in numbers:
        rows = rng.choice(num_points, seen, replace=False)
        observed = Observations(rng.uniform(0, 240, (seen, 2)), rng.uniform(1, 9, seen), rows)
        keyframe = Keyframe(number, 0.1 * number, GRAY, Rigid3.exp(rng.normal(0, 0.1, 6)), observed)
        keyframe.descriptors = rng.integers(1, 255, (seen, 128)).astype(np.uint8)
        model.keyframes.append(keyframe)
    return model


def rows_of(keyframe: Keyframe) -> dict[int, tuple]:
    """What it saw, by point."""
    parts = keyframe.pixels, keyframe.disparity_px, keyframe.descriptors
    return {int(p): (*pixel, d, *desc) for p, pixel, d, desc in zip(keyframe.point, *parts, strict=True)}


@pytest.mark.parametrize("seed", range(8))
def test_points_that_become_one_keep_the_observations_of_both(seed):
    rng = np.random.default_rng(seed)
    model = some_map(rng, range(6))
    before, positions = [rows_of(k) for k in model.keyframes], model.xyz.copy()
    gone = rng.choice(60, 15, replace=False)
    kept = rng.choice(np.setdiff1d(np.arange(60), gone), 15)  # one may take in several
    into = model.merge_points(gone, kept)
    expected = np.arange(60)
    expected[gone] = kept
    np.testing.assert_array_equal(into, expected)
    for keyframe, old in zip(model.keyframes, before, strict=True):
        now = rows_of(keyframe)
        assert len(now) == len(keyframe.point)  # each point at most once
        assert set(now) == {int(into[p]) for p in old} and not set(now) & set(gone.tolist())
        for point, seen in now.items():
            # Its own observation where there was one, else one of those that became it.
            sources = [point] if point in old else [p for p in old if into[p] == point]
            assert seen in [old[p] for p in sources]
    assert np.isnan(model.xyz[gone]).all()
    others = np.setdiff1d(np.arange(60), gone)
    np.testing.assert_array_equal(model.xyz[others], positions[others])
    np.testing.assert_array_equal(model.merge_points(gone[:0], kept[:0]), np.arange(60))


@pytest.mark.parametrize("numbers", [([0, 1, 5, 6], [2, 3, 4]), ([0, 2], [7, 9, 12]), ([8, 9], [1, 2, 3])])
def test_a_map_that_takes_in_another_keeps_what_every_observation_says(rng, numbers):
    one, other = (some_map(rng, n) for n in numbers)

    def given(model: SlamMap) -> dict[int, list]:
        return {
            k.number: [
                (
                    *pixel, *model.xyz[p], *model.anchor_px[p],
                    model.keyframes[model.anchor[p]].number, model.num_agreed[p],
                )
                for pixel, p in zip(k.pixels, k.point, strict=True)
            ]
            for k in model.keyframes
        }  # fmt: skip

    expected = {**given(one), **given(other)}
    offset = one.absorb(other)
    assert offset == 60 and one.num_points == 120
    assert not other.keyframes and not other.num_points
    assert [k.number for k in one.keyframes] == sorted([*numbers[0], *numbers[1]])  # the newest is the last
    found = given(one)
    for number, rows in expected.items():
        np.testing.assert_array_equal(found[number], rows)


def test_a_similarity_keeps_what_is_seen(rng):
    model = some_map(rng, range(5))
    views = [CAMERA.project(k.cam_from_world.apply(model.xyz[k.point])) for k in model.keyframes]
    there_from_here = Similarity3(
        np.array(2.7), Rigid3.exp(rng.normal(0, 1, 6)).rotation, rng.normal(0, 5, 3)
    )
    model.move(there_from_here)
    for keyframe, before in zip(model.keyframes, views, strict=True):
        after = CAMERA.project(keyframe.cam_from_world.apply(model.xyz[keyframe.point]))
        np.testing.assert_allclose(after, before, atol=1e-8)
        assert keyframe.unit == pytest.approx(2.7)
    model.move(there_from_here.inverse())
    assert model.keyframes[0].unit == pytest.approx(1.0)


def test_the_path_goes_along_into_another_world_and_unit(rng):
    model, path = some_map(rng, [0, 4]), Path()
    positions = [Rigid3.exp(rng.normal(0, 0.3, 6)) for _ in range(6)]
    for n, position in enumerate(positions[:3]):
        path.add(n, 0.1 * n, model.keyframes[0], position, np.eye(6))
    move = Similarity3(np.array(0.4), Rigid3.exp(rng.normal(0, 1, 6)).rotation, rng.normal(0, 5, 3))
    model.move(move)
    for n, position in enumerate(positions[3:], 3):  # told in the new unit
        path.add(n, 0.1 * n, model.keyframes[1], move.move_cam_from_source(position), np.eye(6))
    found = path.trajectory(model.keyframes)
    expected = [move.move_cam_from_source(position).inverse() for position in positions]
    np.testing.assert_allclose(
        found.world_from_body.translation, [e.translation for e in expected], atol=1e-9
    )
    np.testing.assert_allclose(found.world_from_body.rotation, [e.rotation for e in expected], atol=1e-9)
    # Deviations of lengths are in the new unit, those of angles as they were.
    variances = np.diagonal(found.covariance, axis1=1, axis2=2)
    np.testing.assert_allclose(variances[:3], np.tile([0.16, 0.16, 0.16, 1.0, 1.0, 1.0], (3, 1)))
    np.testing.assert_allclose(variances[3:], 1.0)
    assert len(path.trajectory(model.keyframes[1:])) == 3
    path.clear(model.keyframes[:1])
    np.testing.assert_allclose(path.trajectory(model.keyframes).timestamp_s, [0.3, 0.4, 0.5])
    assert len(path.trajectory([])) == 0


# A ring with a drift that is known.

COUNT, EACH, REACH = 40, 45, 3


def ring(turn_rad: float, growth: float) -> tuple[SlamMap, Rigid3, np.ndarray, Similarity3]:
    """A map that drifts by so much in every step of a ring, the true places, the true points, and true_from_drifted at the end.

    Every keyframe is the first to see points that the next ones see, too.
    """
    rng = np.random.default_rng(3)
    angle = 2 * np.pi * np.arange(COUNT) / COUNT
    positions = [
        (Rigid3(np.eye(3), np.array([0.0, 0.0, -1.0])) @ Rigid3.exp(np.array([0, 0, 0, 0, -a, 0])))
        for a in angle
    ]  # cam_from_world, looking outward from a circle of radius 1
    step = Similarity3(
        np.array(growth), Rigid3.exp(np.array([0, 0, 0, 0.3 * turn_rad, turn_rad, 0])).rotation, np.zeros(3)
    )

    def similarity(position: Rigid3) -> Similarity3:
        return Similarity3(np.array(1.0), position.rotation, position.translation)

    drifted = [similarity(positions[0].inverse())]
    for before, after in pairwise(positions):
        drifted.append(drifted[-1] @ similarity(before @ after.inverse()) @ step)
    model, true_points = SlamMap(), []
    for k in range(COUNT):
        local = rng.uniform([-1, -1, 1.5], [1, 1, 2.5], (EACH, 3))
        model.add_points(drifted[k].apply(local), np.full((EACH, 2), 100.0), k)
        true_points.append(positions[k].inverse().apply(local))
    for k in range(COUNT):
        rows = np.concatenate([EACH * j + np.arange(EACH) for j in range(max(0, k - REACH), k + 1)])
        seen = Observations(np.full((len(rows), 2), 100.0), np.full(len(rows), np.nan), rows)
        position = Rigid3(drifted[k].rotation, drifted[k].translation).inverse()
        model.keyframes.append(Keyframe(k, 0.1 * k, GRAY, position, seen))
    truth = Rigid3(np.stack([p.rotation for p in positions]), np.stack([p.translation for p in positions]))
    there_from_here = similarity(positions[-1].inverse()) @ drifted[-1].inverse()
    return model, truth, np.concatenate(true_points), there_from_here


def off_truth(model: SlamMap, truth: Rigid3) -> np.ndarray:
    ours = np.array([k.cam_from_world.inverse().translation for k in model.keyframes])
    return np.linalg.norm(ours - truth.inverse().translation, axis=1)


def tie_of(model: SlamMap, there_from_here: Similarity3) -> LoopConstraint:
    found = Recognition(0, 50, "", Rigid3.identity(), np.zeros((0, 2)), np.zeros(0, np.int64))
    return LoopConstraint(model, 0, there_from_here, found)


@pytest.mark.parametrize(("rotation_deg", "growth"), [(0.3, 1.0), (-0.1, 1.0), (0.2, 0.99), (0.0, 1.02)])
def test_an_even_drift_is_taken_out_of_a_ring(rotation_deg, growth):
    """Drift is the same in every step: spread evenly it is gone, and places and points are the true ones."""
    model, truth, true_points, there_from_here = ring(np.deg2rad(rotation_deg), growth)
    before, points_before = off_truth(model, truth), np.linalg.norm(model.xyz - true_points, axis=1)
    assert before.max() > 0.05
    assert correct_drift(model, tie_of(model, there_from_here), CAMERA, is_metric=growth == 1.0)
    after = off_truth(model, truth)
    assert after.max() < 0.1 * before.max() and after[0] < 1e-9  # the first keyframe is the world
    assert np.linalg.norm(model.xyz - true_points, axis=1).max() < 0.1 * points_before.max()
    if growth == 1.0:
        assert all(k.unit == 1.0 for k in model.keyframes)
    else:
        expected = growth ** -np.arange(COUNT)
        np.testing.assert_allclose([k.unit for k in model.keyframes], expected, rtol=0.02)


@pytest.mark.parametrize("is_metric", [True, False])
@pytest.mark.parametrize("rotation_deg", [90.0, -20.0])
def test_a_false_tie_is_rejected_and_moves_nothing(is_metric, rotation_deg):
    """A place on another side of the ring."""
    model, _, _, _ = ring(0.0, 1.0)
    positions, points = [k.cam_from_world.log() for k in model.keyframes], model.xyz.copy()
    rotated = Rigid3.exp(np.array([0, 0, 0, 0, np.deg2rad(rotation_deg), 0]))
    false = Similarity3(np.array(1.0), rotated.rotation, rotated.translation)
    assert not correct_drift(model, tie_of(model, false), CAMERA, is_metric=is_metric)
    np.testing.assert_array_equal(model.xyz, points)
    np.testing.assert_array_equal([k.cam_from_world.log() for k in model.keyframes], positions)


# What is believed.


class Recognized:
    """Stands in for the comparison of images: of each map the poses by which its keyframes seem to see the newest."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.poses: dict[int, list[Rigid3]] = {}
        none = np.zeros((0, 2)), np.zeros((0, 128), np.uint8), np.zeros(8192, np.float32)
        monkeypatch.setattr(loop_closing, "describe_keyframe", lambda keyframe: View(GRAY, *none))
        monkeypatch.setattr(
            loop_closing, "most_alike", lambda descriptor, model, *_: [(k, 1.0) for k in self._of(model)]
        )
        monkeypatch.setattr(loop_closing, "recognize", self.recognize)

    def _of(self, model: SlamMap) -> range:
        return range(len(self.poses.get(id(model), [])))

    def recognize(self, view, model, number, *_) -> Recognition:
        if number not in self._of(model):
            return Recognition(
                number, 3, "3 points match", Rigid3.identity(), GRAY[:0, :2], np.zeros(0, np.int64)
            )
        position = self.poses[id(model)][number]
        rows = np.flatnonzero(np.isfinite(model.xyz[:, 0]))
        return Recognition(number, 60, "", position, np.zeros((len(rows), 2)), rows)


def closer(is_metric: bool = True) -> LoopCloser:
    return LoopCloser(CAMERA, SlamConfig(), is_metric=is_metric)


def add_keyframe(rng, model: SlamMap, number: int) -> Keyframe:
    """A step aside."""
    position = Rigid3(np.eye(3), np.array([-0.05 * number, 0.0, 0.0]))
    seen = Observations(rng.uniform(0, 240, (20, 2)), np.full(20, np.nan), np.arange(20))
    model.keyframes.append(Keyframe(number, 0.1 * number, GRAY, position, seen))
    return model.keyframes[-1]


@pytest.mark.parametrize("num_others", [0, 6])
def test_a_place_is_believed_when_three_keyframes_tell_it(rng, monkeypatch, num_others):
    """However many other maps wait to be joined."""
    there, here = some_map(rng, range(3)), some_map(rng, [20])
    others = [some_map(rng, range(3)) for _ in range(num_others)]
    is_alike, sought = Recognized(monkeypatch), closer()
    there_from_here = Rigid3(np.eye(3), np.array([0.1, 0.0, 0.0]))
    verdicts = []
    for number in range(21, 25):
        newest = add_keyframe(rng, here, number)
        is_alike.poses = {id(there): [newest.cam_from_world @ there_from_here.inverse()]}
        ties = [sought.consider(here, model) for model in [there, *others]]
        verdicts.append([constraint is not None for constraint in ties])
        if ties[0] is not None:
            np.testing.assert_allclose(ties[0].there_from_here.translation, [0.1, 0, 0], atol=1e-12)
            break
    assert [v[0] for v in verdicts] == [False, False, True] and not any(any(v[1:]) for v in verdicts)
    assert [loop.verdict for loop in sought.ledger] == ["waiting", "waiting", "accepted"]
    sought.reject_last("it does not fit")
    assert (sought.ledger[-1].verdict, sought.ledger[-1].reason) == ("rejected", "it does not fit")


def test_what_is_told_differently_each_time_or_too_seldom_is_not_believed(rng, monkeypatch):
    there, here = some_map(rng, range(3)), some_map(rng, [20])
    is_alike, sought = Recognized(monkeypatch), closer()
    for number in range(21, 30):  # always somewhere else
        newest = add_keyframe(rng, here, number)
        is_alike.poses = {
            id(there): [newest.cam_from_world @ Rigid3.exp(np.array([0.5 * number, 0, 0, 0, 0, 0]))]
        }
        assert sought.consider(here, there) is None
    sought.clear()
    for number in range(30, 60):  # the same, with more silence in between than is waited
        newest = add_keyframe(rng, here, number)
        is_alike.poses = {id(there): [newest.cam_from_world]} if number % 6 == 0 else {}
        assert sought.consider(here, there) is None
    assert not any(loop.verdict == "accepted" for loop in sought.ledger)
    assert sum(loop.reason == "confirmed by 1 of 3 keyframes" for loop in sought.ledger) == 9 + 5


def test_two_places_that_look_like_one_are_doubtful(rng, monkeypatch):
    there, here = some_map(rng, range(3)), some_map(rng, [20])
    is_alike, sought = Recognized(monkeypatch), closer()
    for number in range(21, 27):
        newest = add_keyframe(rng, here, number).cam_from_world
        is_alike.poses = {id(there): [newest, Rigid3(np.eye(3), np.array([1.0, 0, 0])) @ newest]}
        assert sought.consider(here, there) is None
    assert {loop.reason for loop in sought.ledger} == {"two different poses match this image"}


def test_a_way_that_would_have_to_be_wrong_by_meters_is_not_believed(rng, monkeypatch):
    model = some_map(rng, [0])
    is_alike, sought = Recognized(monkeypatch), closer()
    for number in range(1, 20):
        newest = add_keyframe(rng, model, number).cam_from_world
        is_alike.poses = {id(model): [Rigid3(np.eye(3), np.array([0.0, 0.0, 3.0])) @ newest]}
        assert sought.consider(model, model) is None
        rotated = Rigid3.exp(np.array([0, 0, 0, 0, 0.3, 0]))
        is_alike.poses = {id(model): [rotated @ newest]}
        assert sought.consider(model, model) is None
    assert {loop.verdict for loop in sought.ledger} == {"rejected"}
    assert any(loop.reason.startswith("the trajectory of length") for loop in sought.ledger)
    assert any(loop.reason.startswith("the rotation of") for loop in sought.ledger)


@pytest.mark.parametrize(("camera", "kind"), [(RGBD, "rgbd"), (MONO, "mono")])
def test_a_real_map_keeps_its_order_and_its_rows(camera, kind):
    slam, _ = tracked(ride().frames(kind), camera)
    numbers = [k.number for k in slam.map.keyframes]
    assert numbers == sorted(set(numbers))
    for keyframe in slam.map.keyframes:
        assert len(np.unique(keyframe.point)) == len(keyframe.point)
        assert keyframe.point.max() < slam.map.num_points and (slam.map.anchor < len(numbers)).all()
        lengths = {
            len(keyframe.pixels),
            len(keyframe.disparity_px),
            len(keyframe.descriptors),
            len(keyframe.point),
        }
        assert len(lengths) == 1
