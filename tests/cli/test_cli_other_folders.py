"""No command writes among the images it reads, or over the results of another."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from epipole import api
from epipole.config import BoardConfig
from epipole.errors import WorkspaceError
from epipole.pipelines.calibration.config import CalibrationConfig
from epipole.pipelines.stereo.run import stereo_many
from epipole.runs import Job, open_run

BOARD = CalibrationConfig(board=BoardConfig(columns=9, rows=6, square=1.0))


def images(folder: Path) -> Path:
    folder.mkdir(parents=True)
    for name in ("a.png", "b.png"):
        Image.fromarray(np.full((48, 64), 90, np.uint8)).save(folder / name)
    return folder


def contents(root: Path) -> dict[str, bytes]:
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in root.rglob("*") if p.is_file()}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Images left and right, and a finished reconstruction of others."""
    for side in ("left", "right"):
        images(tmp_path / side)
    job = Job(kind="reconstruct", inputs=(tmp_path / "right",), settings={})
    with open_run(job, tmp_path / "model") as run:
        run.folder.write_text("report.html", "of the model")
        run.finish({"num_images": 2})
    return tmp_path


@pytest.mark.parametrize("out", ["left", "right", ".", "model"])
def test_pairs_and_boards_leave_pictures_and_models_alone(root: Path, out: str) -> None:
    before = contents(root)
    with pytest.raises(WorkspaceError, match="choose another"):
        stereo_many(root / "left", root / "right", root / out)
    with pytest.raises(WorkspaceError, match="choose another"):
        api.calibrate(root / "left", root / out, BOARD, right=root / "right")
    with pytest.raises(WorkspaceError, match="choose another"):
        api.stereo(root / "left" / "a.png", root / "right" / "a.png", root / out)
    if out != "right":
        with pytest.raises(WorkspaceError, match="choose another"):
            api.reconstruct(root / "left", root / out)
    assert contents(root) == before
