"""Real roots and the motions of an essential matrix, against known answers."""

import numpy as np
import pytest
from numpy.polynomial import polynomial

from epipole.geometry import Rigid3, essential_from_cam2_from_cam1
from epipole.solvers._polynomial_kernels import real_roots, roots_workspace
from epipole.solvers._two_view_kernels import motions_from_essential


def roots_of(coefficients):
    found = np.empty(len(coefficients))
    return found[: real_roots(np.asarray(coefficients, float), roots_workspace(), found)]


@pytest.mark.parametrize("degree", range(1, 11))
@pytest.mark.parametrize("unit", [1e-3, 1.0, 50.0])
def test_all_real_roots_are_found_ascending(rng, degree, unit):
    for _ in range(50):
        true = unit * np.sort(rng.normal(size=degree))
        found = roots_of(polynomial.polyfromroots(true))
        assert len(found) == degree
        np.testing.assert_allclose(found, true, atol=1e-4 * unit)


def test_complex_roots_are_left_out(rng):
    for _ in range(100):
        pairs, true = rng.normal(size=(3, 2)), np.sort(rng.normal(size=4))
        coefficients = polynomial.polyfromroots(true)
        for a, b in pairs:
            coefficients = polynomial.polymul(coefficients, [a * a + b * b + 0.01, -2 * a, 1.0])
        np.testing.assert_allclose(roots_of(coefficients), true, atol=1e-6)


def test_roots_of_degenerate_polynomials():
    assert len(roots_of([0.0, 0.0, 0.0])) == 0
    assert len(roots_of([2.0, 0.0, 0.0])) == 0
    assert len(roots_of([np.nan, 1.0])) == 0
    assert len(roots_of([np.inf, 1.0])) == 0
    np.testing.assert_allclose(roots_of([-6.0, 1.0, 1.0, 0.0, 0.0]), [-3.0, 2.0])
    np.testing.assert_allclose(roots_of([0.0, -1.0, 0.0, 1.0]), [-1.0, 0.0, 1.0], atol=1e-15)
    np.testing.assert_allclose(roots_of([1.0, -2.0, 1.0]), [1.0], atol=1e-6)  # a double root counts once


def test_motions_of_an_essential_matrix_contain_the_truth(rng):
    for _ in range(50):
        direction = rng.normal(size=3)
        truth = Rigid3(Rigid3.exp(rng.normal(size=6)).rotation, direction / np.linalg.norm(direction))
        points = rng.uniform(-1, 1, (5, 3)) + np.array([0, 0, 4.0])
        both = np.stack([points, truth.apply(points)])
        both = both[:, (both[..., 2] > 0.1).all(axis=0)]
        rays = both / both[..., 2:]
        motions = np.empty((4, 12))
        essential = essential_from_cam2_from_cam1(truth)
        count = motions_from_essential(
            (essential / np.linalg.norm(essential)).ravel(), rays[0], rays[1], motions
        )
        expected = np.concatenate([truth.rotation.ravel(), truth.translation])
        assert np.abs(motions[:count] - expected).max(axis=1).min() < 1e-9
        for motion in motions[:count]:
            rotation = motion[:9].reshape(3, 3)
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
            again = essential_from_cam2_from_cam1(Rigid3(rotation, motion[9:]))
            assert abs(abs((again * essential).sum()) / (again**2).sum() - 1.0) < 1e-9
