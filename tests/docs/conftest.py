"""One small reconstruction for all tests of the pages in a process."""

from pathlib import Path

import pytest
from docs_setups import photographs

import epipole
import type_checks


@pytest.fixture(scope="session")
def reconstructed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """IMAGES, six rendered photographs; OUT, their reconstruction; DIR, the true cameras."""
    folder = tmp_path_factory.mktemp("reconstructed")
    photographs(folder)
    with type_checks.switched_off():
        result = epipole.reconstruct(folder / "IMAGES", folder / "OUT")
    assert result.model.is_registered().all()
    return folder
