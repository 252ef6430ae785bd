"""Frames that are rendered once for all workers of a test run."""

import os
from pathlib import Path

import pytest
from slam_rides import Shared


@pytest.fixture(scope="session", autouse=True)
def shared_frames(tmp_path_factory: pytest.TempPathFactory) -> None:
    """A folder beside those of the workers, in what pytest removes after some runs."""
    own = tmp_path_factory.getbasetemp()
    folder: Path = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "slam_rides"
    folder.mkdir(exist_ok=True)
    Shared.folder = folder
