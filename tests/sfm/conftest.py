import shutil
from pathlib import Path

import pytest
from photographs import neighboring_views, render_to
from sfm_rings import view_graph_of

from epipole.scene import Reconstruction, ViewGraph
from epipole.synthetic.problems import bundle_problem


@pytest.fixture(scope="session")
def rendered(tmp_path_factory) -> Path:
    """A folder of six rendered photographs with EXIF."""
    folder = tmp_path_factory.mktemp("rendered") / "photographs"
    render_to(folder, neighboring_views(6))
    return folder


@pytest.fixture(scope="session")
def few(rendered, tmp_path_factory) -> Path:
    """A folder of the first four."""
    folder = tmp_path_factory.mktemp("few") / "photographs"
    folder.mkdir()
    for path in sorted(rendered.iterdir())[:4]:
        shutil.copy2(path, folder / path.name)
    return folder


@pytest.fixture(scope="session")
def reconstructed(rendered, tmp_path_factory):
    """The result of the six, in a folder that no test changes."""
    from epipole import reconstruct

    return reconstruct(rendered, tmp_path_factory.mktemp("reconstructed") / "out")


@pytest.fixture
def out_of_six(reconstructed, tmp_path) -> Path:
    """A copy of the folder, with the features and matches."""
    return Path(shutil.copytree(reconstructed.out, tmp_path / "out"))


@pytest.fixture(scope="session")
def ring() -> Reconstruction:
    """Twelve images around a ball of points, five of which see each point, without noise."""
    return bundle_problem(12, 900, 5).truth


@pytest.fixture(scope="session")
def graph(ring: Reconstruction) -> ViewGraph:
    return view_graph_of(ring)
