"""Hypothesis strategies for what files hold: reconstructions, pose graphs, maps."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from any_geometry import GROUPS, cameras, numbers, twists
from epipole.cameras import CameraModel
from epipole.geometry import Rigid2, Rigid3, Similarity3
from epipole.optim import PoseGraph
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks

COORDINATE = numbers(-1e6, 1e6)

# Line breaks and zeros cannot stand in COLMAP's files; the writer refuses them, and so it is tested elsewhere.
FILE_NAME = st.text(
    st.characters(exclude_categories=["Cs", "Cc", "Zl", "Zp"], exclude_characters="\\"),
    min_size=1,
    max_size=12,
).filter(lambda name: name == name.strip())


def rows(
    count: int, width: int, values: st.SearchStrategy[float] = COORDINATE
) -> st.SearchStrategy[np.ndarray]:
    return arrays_of.arrays(np.float64, (count, width), elements=values)


@st.composite
def _tracks(draw: st.DrawFn, keypoints_of: list[int]) -> tuple[int, Tracks]:
    """Each keypoint sees one point or none, so that no image sees a point twice with one keypoint."""
    num_points = draw(st.integers(0, 4))
    seen = [
        (draw(st.integers(-1, num_points - 1)), image, keypoint)
        for image, count in enumerate(keypoints_of)
        for keypoint in range(count)
    ]
    table = np.array(sorted(row for row in seen if row[0] >= 0), np.int64).reshape(-1, 3)
    lengths = np.bincount(table[:, 0], minlength=num_points)
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    return num_points, Tracks(offsets, table[:, 1].astype(np.int32), table[:, 2].astype(np.int32))


@st.composite
def reconstructions(draw: st.DrawFn, models: tuple[CameraModel, ...] = tuple(CameraModel)) -> Reconstruction:
    """A rig of two cameras and a single camera, or either; frames with all of a rig's images or one of them."""
    kinds = draw(st.lists(st.sampled_from([1, 2]), min_size=1, max_size=2))
    lenses = [draw(cameras(model=draw(st.sampled_from(models)))) for _ in range(sum(kinds))]
    to_sensor = np.array([draw(twists()) for _ in lenses])
    first = np.concatenate([[0], np.cumsum(kinds)]).astype(np.int32)
    to_sensor[first[:-1]] = 0.0
    frames, images = [], []
    for number in range(draw(st.integers(1, 3))):
        rig = draw(st.integers(0, len(kinds) - 1))
        sensors = sorted(draw(st.sets(st.integers(first[rig], first[rig + 1] - 1), min_size=1)))
        frames.append((rig, draw(twists())))
        images += [(number, sensor) for sensor in sensors]
    names = draw(st.lists(FILE_NAME, min_size=len(images), max_size=len(images), unique=True))
    counts = [draw(st.integers(0, 4)) for _ in images]
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    num_points, tracks = draw(_tracks(counts))
    rigs = Rigs(first, np.arange(len(lenses), dtype=np.int32), Rigid3.exp(to_sensor))
    positions = Rigid3.exp(np.array([xi for _, xi in frames]))
    rig_rows = np.array([rig for rig, _ in frames], np.int32)
    frame, sensor = np.array(images, np.int32).T.copy()
    colors = draw(arrays_of.arrays(np.uint8, (num_points, 3)))
    error = draw(arrays_of.arrays(np.float64, num_points, elements=numbers(0, 50) | st.just(float("nan"))))
    return Reconstruction(
        Cameras.from_list(lenses),
        rigs,
        Frames(rig_rows, positions, np.full(len(frames), np.nan)),
        Images(tuple(names), frame, sensor, offsets, draw(rows(int(offsets[-1]), 2, numbers(-1e4, 1e4)))),
        Points(draw(rows(num_points, 3)), colors, error),
        tracks,
    )


@st.composite
def pose_graphs(draw: st.DrawFn) -> PoseGraph:
    """A few places of one kind with edges among them."""
    kind = draw(st.sampled_from([Rigid2, Rigid3, Similarity3]))
    dimension = {Rigid2: 3, Rigid3: 6, Similarity3: 7}[kind]
    n, m = draw(st.integers(1, 4)), draw(st.integers(0, 4))
    positions = kind.exp(np.array([draw(GROUPS[kind]) for _ in range(n)]))
    measured = kind.exp(np.array([draw(GROUPS[kind]) for _ in range(m)]).reshape(m, dimension))
    ends = draw(arrays_of.arrays(np.int64, (2, m), elements=st.integers(0, n - 1)))
    root = draw(arrays_of.arrays(np.float64, (m, dimension, dimension), elements=numbers(-5, 5)))
    information = root @ np.swapaxes(root, 1, 2) + np.eye(dimension)
    information = 0.5 * (information + np.swapaxes(information, 1, 2))
    fixed = np.array(sorted(draw(st.sets(st.integers(0, n - 1)))), np.int64)
    return PoseGraph(positions, ends[0].copy(), ends[1].copy(), measured, information, fixed)


def maps(low: float, high: float) -> st.SearchStrategy[np.ndarray]:
    """A map (h, w) of single precision with holes."""
    value = st.floats(low, high, width=32) | st.just(float("nan"))
    shape = arrays_of.array_shapes(min_dims=2, max_dims=2, max_side=7)
    return arrays_of.arrays(np.float32, shape, elements=value)
