"""One small reconstruction for all tests of the pages in a process."""

from pathlib import Path

import jaxtyping
import pytest
from docs_setups import photographs

import epipole


@pytest.fixture(scope="session")
def reconstructed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """IMAGES, six rendered photographs; OUT, their reconstruction; DIR, the true cameras."""
    folder = tmp_path_factory.mktemp("reconstructed")
    photographs(folder)
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        result = epipole.reconstruct(folder / "IMAGES", folder / "OUT")
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
    assert result.model.is_registered().all()
    return folder
