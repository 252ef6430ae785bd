"""The deviation of a focal length that was found from images is that of the whole lens, not of the pixels' noise alone."""

from types import SimpleNamespace

import pytest

from epipole.pipelines.slam.sources.intrinsics import _honest_sigma_px

pytestmark = pytest.mark.usefixtures("unchecked")


@pytest.mark.parametrize(
    ("focals", "expected"),
    [
        ([{"camera": 0, "sigma_px": 12.6}], 12.6),
        ([{"camera": 0, "sigma_px": 0.5}], 2.0),
        ([{"camera": 0, "sigma_px": None}], 2.0),
        ([{"camera": 1, "sigma_px": 9.0}], 2.0),
        ([], 2.0),
    ],
)
def test_the_larger_deviation_counts(focals, expected):
    assert _honest_sigma_px(SimpleNamespace(summary={"focals": focals}), 2.0) == expected
