from pathlib import Path

import pytest
from photographs import neighbouring_views, render_to


@pytest.fixture(scope="session")
def rendered(tmp_path_factory) -> Path:
    """A folder of six rendered photographs with EXIF."""
    folder = tmp_path_factory.mktemp("rendered") / "photographs"
    render_to(folder, neighbouring_views(6))
    return folder
