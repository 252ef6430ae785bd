"""Hypothesis strategies for what the laws speak about: motions, cameras, pixels, points."""

import numpy as np
from hypothesis import strategies as st

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid2, Rigid3, Rotation3, Similarity3

WIDTH, HEIGHT = 640, 480
MODELS = st.sampled_from(list(CameraModel))


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_infinity=False)


def vectors(size: int, reach: float) -> st.SearchStrategy[np.ndarray]:
    return st.lists(numbers(-reach, reach), min_size=size, max_size=size).map(np.array)


@st.composite
def turns(draw: st.DrawFn, largest_rad: float = 3.1) -> np.ndarray:
    """A rotation vector whose angle is below `largest_rad`; none and tiny ones among them."""
    phi = draw(vectors(3, 1.0))
    size = float(np.linalg.norm(phi))
    return (
        phi * min(1.0, largest_rad / max(size, 1e-300)) * draw(st.sampled_from([1.0, 1.0, 3.0 / 1.75, 1e-6]))
    )


@st.composite
def twists(draw: st.DrawFn) -> np.ndarray:
    return np.concatenate([draw(vectors(3, 10.0)), draw(turns())])


@st.composite
def similarity_tangents(draw: st.DrawFn) -> np.ndarray:
    return np.concatenate([draw(twists()), [draw(numbers(-2.0, 2.0))]])


def plane_twists() -> st.SearchStrategy[np.ndarray]:
    return st.tuples(numbers(-10, 10), numbers(-10, 10), numbers(-3.1, 3.1)).map(np.array)


GROUPS = {
    Rotation3: turns(),
    Rigid2: plane_twists(),
    Rigid3: twists(),
    Similarity3: similarity_tangents(),
}
"""Each group with tangents that its logarithm gives back."""


def pixels() -> st.SearchStrategy[np.ndarray]:
    """A handful of places in an image, its borders among them."""
    one = st.tuples(numbers(-0.5, WIDTH - 0.5), numbers(-0.5, HEIGHT - 0.5))
    return st.lists(one, min_size=1, max_size=6).map(np.array)


@st.composite
def cameras(draw: st.DrawFn, bend: float = 0.03, model: CameraModel | None = None) -> Camera:
    """A camera of any model; `bend` bounds its distortion (0.03 and less has an inverse in all of the image)."""
    model = draw(MODELS) if model is None else model
    focal = [draw(numbers(400.0, 2000.0)) for _ in model.focal_indices]
    middle = [draw(numbers(250.0, 390.0)), draw(numbers(180.0, 300.0))]
    camera = [round(draw(numbers(-bend, bend)), 9) for _ in model.distortion_indices]
    if model in (CameraModel.OPENCV, CameraModel.FULL_OPENCV):
        camera[2:4] = [0.05 * value for value in camera[2:4]]  # decentering is small
    return Camera(model, WIDTH, HEIGHT, np.array([*focal, *middle, *camera]))


@st.composite
def calibration_matrices(draw: st.DrawFn) -> np.ndarray:
    fx, fy = draw(numbers(300, 2000)), draw(numbers(300, 2000))
    return np.array([[fx, 0, draw(numbers(0, 700))], [0, fy, draw(numbers(0, 500))], [0, 0, 1.0]])


@st.composite
def points_ahead(draw: st.DrawFn, least: int = 1, most: int = 12) -> np.ndarray:
    """Points (n, 3) that stand well before a camera at the origin, at depths 4 to 9."""
    one = st.tuples(numbers(-2, 2), numbers(-2, 2), numbers(4, 9))
    return np.array(draw(st.lists(one, min_size=least, max_size=most)))


@st.composite
def steps_aside(draw: st.DrawFn) -> Rigid3:
    """cam2_from_cam1 with a baseline of 0.3 to 2, after which points ahead are still ahead."""
    direction = draw(vectors(3, 1.0).filter(lambda v: np.linalg.norm(v) > 0.1))
    length = draw(numbers(0.3, 2.0))
    turn = draw(vectors(3, 0.15))
    return Rigid3(Rotation3.exp(turn).matrix, length * direction / np.linalg.norm(direction))
