"""Merging, triangulating, extending and filtering tracks against sets and the interpreter."""

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3
from epipole.mapping import MatchComponents, ModelBuilder, model_builder
from epipole.mapping import _component_kernels as component_kernels
from epipole.mapping import _track_kernels as kernels
from epipole.scene import Cameras
from epipole.synthetic import look_at
from kernel_references import assert_same_as_python, record_calls, reference_of

LENS = Camera(CameraModel.RADIAL, 1000, 800, np.array([900.0, 499.5, 399.5, -0.1, 0.02]))
PINHOLE = Camera(CameraModel.PINHOLE, 1000, 800, np.array([900.0, 900.0, 499.5, 399.5]))
PLACES = [look_at((5 * np.cos(a), 5 * np.sin(a), 1.0), (0, 0, 0)) for a in (0.0, 0.002, 0.5, 0.9)]


def merged(row1: np.ndarray, row2: np.ndarray, image: np.ndarray) -> list[int]:
    """The smallest row of each row's component, with sets."""
    component = [{i} for i in range(len(image))]
    for a, b in zip(row1, row2):
        one, other = component[a], component[b]
        if one is not other and not {image[i] for i in one} & {image[i] for i in other}:
            one |= other
            for i in other:
                component[i] = one
    return [min(c) for c in component]


@pytest.mark.parametrize(("num_rows", "num_matches"), [(40, 60), (40, 10), (1, 0), (0, 0), (2, 3)])
@reference_of(component_kernels.connect_without_conflict, component_kernels.find_roots)
def test_components_are_merged(rng: np.random.Generator, num_rows: int, num_matches: int) -> None:
    num_images = 5
    image = np.sort(rng.integers(0, num_images, num_rows))
    row1, row2 = rng.integers(0, max(num_rows, 1), (2, num_matches))
    starts = np.searchsorted(image, np.arange(num_images + 1))
    pairs = [image[row].astype(np.int32) if num_rows else row.astype(np.int32) for row in (row1, row2)]
    keypoints = [(row - starts[pair]).astype(np.int32) for row, pair in zip((row1, row2), pairs)]
    order, offsets = rng.permutation(num_matches), np.arange(num_matches + 1)
    parent = np.arange(num_rows, dtype=np.int64)
    stamp = np.zeros(num_images + 1, np.int64)
    found = component_kernels.Components(parent, parent.copy(), np.ones(num_rows, np.int64), stamp)
    half = num_matches // 2
    number, members, used = 0, image.astype(np.int32), num_rows
    for part in (order[:half], order[half:]):  # the second call continues the first one
        given = part, offsets, *pairs, *keypoints, starts, number, found, members, used
        (number, members, used), changed = assert_same_as_python(
            component_kernels.connect_without_conflict, *given
        )
        found = changed[8]
    _, (roots,) = assert_same_as_python(component_kernels.find_roots, found.parent)
    assert number == num_matches
    np.testing.assert_array_equal(roots, merged(row1[order], row2[order], image))


def model(rng: np.random.Generator, num_points: int) -> ModelBuilder:
    """Four views of each point, the third of a second camera; some keypoints are wrong, one has no ray."""
    points = rng.uniform(-1, 1, (num_points, 3))
    cameras = [PINHOLE, PINHOLE, LENS, PINHOLE]
    keypoints = [
        c.project(p.apply(points)) + 0.3 * rng.normal(size=(num_points, 2)) for c, p in zip(cameras, PLACES)
    ]
    keypoints[3][::3] += 90.0
    keypoints[2][:1] = 1e6
    image = np.tile(np.arange(4, dtype=np.int32), num_points)
    keypoint = np.repeat(np.arange(num_points, dtype=np.int32), 4)
    components = MatchComponents(np.arange(0, 4 * num_points + 1, 4), image, keypoint)
    return ModelBuilder(
        Cameras.from_list([PINHOLE, LENS]), np.array([0, 0, 1, 0], np.int32), keypoints, components
    )


@pytest.mark.parametrize("num_points", [9, 1])
@reference_of(kernels.triangulate_components, kernels.extend_components, kernels.filter_points)
def test_tracks_become_points(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, num_points: int
) -> None:
    steps = kernels.triangulate_components, kernels.extend_components, kernels.filter_points
    calls = {step: record_calls(monkeypatch, model_builder, step) for step in steps}
    builder = model(rng, num_points)
    every = np.arange(num_points)
    builder.triangulate(every, 4.0, 0.01)  # no image is registered
    for image, position in enumerate(PLACES[:3]):
        builder.register(image, Rigid3(position.rotation, position.translation))
    builder.triangulate(every, 4.0, 0.01)
    made = builder.num_points
    builder.register(3, Rigid3(PLACES[3].rotation, PLACES[3].translation))
    builder.extend(every, 4.0)
    builder.extend(every[:0], 4.0)
    behind_some = np.array([[50.0, 0.0, 0.0]])[:made]
    builder.set_points(np.arange(min(made, 1)), behind_some, np.flatnonzero(builder.row_point == 0))
    builder.filter(4.0, 0.01)
    builder.filter(0.2, 0.3)
    assert made > num_points // 2 or num_points == 1
    for step, recorded in calls.items():
        for arguments in recorded:
            assert_same_as_python(step, *arguments)
            *before, _, stop = arguments[:6]
            assert_same_as_python(step, *before, stop, stop, *arguments[6:])  # no component, no point
        assert recorded or made == 0
