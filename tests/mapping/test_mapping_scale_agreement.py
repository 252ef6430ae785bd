"""Several estimates of a scale: what they give together, and contradictions."""

import numpy as np
import pytest

from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.scale import ScaleEstimate, agreed_scale


def estimate(scale, sigma=0.01, name="x", kind="length", shared=0.0):
    return ScaleEstimate(kind, name, scale, sigma, shared, "")


def test_independent_estimates_are_averaged_by_their_deviations(rng):
    away = []
    for _ in range(300):
        sigmas = rng.uniform(0.005, 0.05, 5)
        found = agreed_scale([estimate(2.0 + s * rng.normal(), s, f"n{n}") for n, s in enumerate(sigmas)])
        away.append((found.scale - 2.0) / found.sigma)
    assert 0.7 < np.std(away) < 1.1


def test_what_all_tags_share_does_not_average_out():
    tags = [estimate(1.0, 0.001, f"tag {n}", "tag", 0.01) for n in range(100)]
    assert agreed_scale(tags).relative_sigma == pytest.approx(0.01, rel=0.01)
    both = agreed_scale([*tags, estimate(1.0, 0.01)])
    assert both.relative_sigma == pytest.approx(0.01 / np.sqrt(2), rel=0.01)
    assert both.in_words() == "meters, from 100 tags and x: known to 0.71 % (1 sigma)"


def test_the_odd_one_out_is_named():
    found = agreed_scale(
        [estimate(1.0, name="a"), estimate(1.01, name="b"), estimate(1.3, name="c")], ["d: no"]
    )
    assert found.kept_mask.tolist() == [True, True, False] and "2 of 3" in repr(found)
    refusal, warning = found.warnings()
    assert refusal == "d: no" and warning.startswith("c is ignored: it would change the scale by +29 %")
    assert [e["kept"] for e in found.summary()["estimates"]] == [True, True, False]


def test_scatter_beyond_the_deviations_makes_the_result_less_sure():
    near = agreed_scale([estimate(s, 0.001, str(s)) for s in (1.0, 1.001, 0.999)])
    far = agreed_scale([estimate(s, 0.001, str(s)) for s in (1.0, 1.01, 0.99)])
    assert far.sigma > 4 * near.sigma


def test_contradiction_and_ignorance_are_refused():
    with pytest.raises(DegenerateGeometryError, match=r"contradict each other.*a 1 .*b 1\.2"):
        agreed_scale([estimate(1.0, name="a"), estimate(1.2, name="b")])
    with pytest.raises(DegenerateGeometryError, match="contradict each other"):
        agreed_scale([estimate(s, name=str(s)) for s in (1.0, 1.01, 1.2, 1.21)])
    with pytest.raises(DegenerateGeometryError, match=r"too uncertain \(30 %\)"):
        agreed_scale([estimate(1.0, 0.3)])
    with pytest.raises(DegenerateGeometryError, match="tag 3: seen in 1 image"):
        agreed_scale([], ["tag 3: seen in 1 image"])
    with pytest.raises(ConfigError, match="positive"):
        agreed_scale([estimate(0.0)])


def test_an_estimate_without_a_note_is_told_by_its_name():
    found = agreed_scale(
        [ScaleEstimate("GPS", "fixes of the phone", 2.0, 0.01), ScaleEstimate("length", "bar", 2.0, 0.01)]
    )
    assert found.in_words().startswith("meters, from fixes of the phone and bar: known to ")
