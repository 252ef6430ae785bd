import sys
from pathlib import Path

import numpy as np
import pytest

from epipole.geometry import Rigid3

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "sfm"))
from photographs import neighboring_views, render_to


def between(views: Rigid3, k: int, fraction: float = 0.5) -> Rigid3:
    """A pose between two neighboring ones."""
    step = (views[k + 1] @ views[k].inverse()).log()
    return Rigid3.exp(fraction * step) @ views[k]


@pytest.fixture(scope="session")
def views() -> Rigid3:
    return neighboring_views(6)


@pytest.fixture(scope="session")
def workspace(views, tmp_path_factory) -> Path:
    """The output folder of a reconstruction of six photographs, which no test changes."""
    from epipole import reconstruct

    folder = tmp_path_factory.mktemp("map")
    render_to(folder / "photographs", views)
    reconstruct(folder / "photographs", folder / "out")
    return folder / "out"


@pytest.fixture(scope="session")
def truth(views) -> Rigid3:
    """Poses of the images to localize."""
    poses = [between(views, k) for k in (0, 2, 4)]
    return Rigid3(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses]))


@pytest.fixture(scope="session")
def photographs(truth, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("localize") / "photographs"
    render_to(folder, truth, "new")
    return folder
