"""Reports to test, made once."""

from dataclasses import replace

import numpy as np
import pytest
from report_ring import HOSTILE, content_of, empty_model, ring_model

from epipole.pipelines.sfm.page.content import ReportContent
from epipole.scene import Points, Reconstruction


@pytest.fixture(scope="session")
def model() -> Reconstruction:
    """Ten placed cameras of twelve, 400 points."""
    return ring_model()


@pytest.fixture(scope="session")
def content(model: Reconstruction) -> ReportContent:
    """A full report's content."""
    return content_of(model)


@pytest.fixture(scope="session")
def empty_content() -> ReportContent:
    """Four images and no model."""
    return content_of(empty_model(4), "Nothing")


@pytest.fixture(scope="session")
def big_content() -> ReportContent:
    """Fifty images and more points than the page shows."""
    base = ring_model(50, num_points=1500, num_absent=3, seed=8)
    rng, num_points = np.random.default_rng(1), 70_000
    extra = num_points - len(base.points)
    cloud = rng.normal(size=(extra, 3)) * (1.2, 1.2, 0.5)
    points = Points(
        np.concatenate([base.points.xyz_in_world, cloud]),
        np.concatenate([base.points.rgb, rng.integers(0, 255, (extra, 3), dtype=np.uint8)]),
        np.full(num_points, 0.5),
    )
    last = base.tracks.offsets[-1]
    offsets = np.concatenate([base.tracks.offsets, np.full(extra, last)])
    return content_of(replace(base, points=points, tracks=replace(base.tracks, offsets=offsets)))


@pytest.fixture(scope="session")
def hostile_content() -> ReportContent:
    """An image whose name tries to break out of the page."""
    base = ring_model(5, num_points=60, num_absent=1)
    names = (
        HOSTILE,
        "]]></script><img src=x onerror=alert(1)>.jpg",
        "\udcff\x00bad.jpg",
        *base.images.name[3:],
    )
    return content_of(replace(base, images=replace(base.images, name=names)), title=HOSTILE)
