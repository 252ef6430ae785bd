"""Rows of projections and rays against the interpreter's."""

import numpy as np
import pytest

from epipole.cameras import CameraModel
from epipole.cameras import _camera_kernels as kernels
from kernel_references import assert_same_as_python, reference_of

LENS = (-0.12, 0.03, 1e-3, -2e-3, 0.004, 0.05, -0.01, 0.002)
every_model = pytest.mark.parametrize("model", list(CameraModel))


def padded(model: CameraModel) -> np.ndarray:
    """A mild lens of this model."""
    focal, center = [400.0, 410.0][: len(model.focal_indices)], [319.5, 239.5]
    values = [*focal, *center, *LENS][: model.num_params]
    return np.concatenate([values, np.zeros(kernels.NUM_PARAMS - len(values))])


def points_and_oddities(rng: np.random.Generator) -> np.ndarray:
    before = rng.normal(size=(8, 3)) * [0.5, 0.4, 0.3] + [0.0, 0.0, 2.0]
    odd = [
        *((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, 0.0, 0.0), (1e-12, 0.0, 1.0), (0.3, 0.2, 0.0)),
        *((0.3, -0.2, -1.0), (1e9, -1e9, 1.0), (1.0, 1.0, 1e-13), (np.nan, 0.0, 1.0), (0.1, 0.1, np.inf)),
    ]
    return np.concatenate([before, odd])


@every_model
@reference_of(kernels.project_all, kernels.project_with_jacobian_all)
def test_projections(model: CameraModel, rng: np.random.Generator) -> None:
    for points in (points_and_oddities(rng), np.empty((0, 3)), np.array([[0.1, 0.2, 1.5]])):
        n = len(points)
        arguments = (int(model), padded(model), points, np.empty((n, 2)))
        _, (*_, plain) = assert_same_as_python(kernels.project_all, *arguments)
        more = np.empty((n, 2, 3)), np.empty((n, 2, kernels.NUM_PARAMS))
        _, after = assert_same_as_python(kernels.project_with_jacobian_all, *arguments, *more)
        np.testing.assert_allclose(after[3], plain, rtol=1e-12)


@every_model
@reference_of(kernels.unproject_all)
def test_rays(model: CameraModel, rng: np.random.Generator) -> None:
    odd = [(319.5, 239.5), (-4000.0, 9000.0), (1e12, 0.0), (np.nan, 3.0), (np.inf, -np.inf)]
    for pixels in (rng.uniform(0, 640, (8, 2)), np.array(odd), np.empty((0, 2))):
        out = np.empty((len(pixels), 3))
        _, (*_, rays) = assert_same_as_python(kernels.unproject_all, int(model), padded(model), pixels, out)
        back = np.empty((len(pixels), 2))
        kernels.project_all(int(model), padded(model), rays, back)
        seen = np.isfinite(rays).all(axis=1)
        np.testing.assert_allclose(back[seen], pixels[seen], rtol=1e-7, atol=1e-7)
