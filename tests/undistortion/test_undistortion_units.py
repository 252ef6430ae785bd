"""Images are undistorted one by one: an interrupted run continues, and a cluster writes the same files."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from epipole.cli.main import main
from epipole.io import write_colmap_model
from epipole.pipelines.undistortion import run
from epipole.pipelines.undistortion.run import undistort
from io_models import mappable_model
from whole import in_whole_run


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """An output folder with a texture in each image."""
    model, rng = mappable_model(), np.random.default_rng(5)
    write_colmap_model(model, tmp_path / "sparse" / "0")
    for n, name in enumerate(model.images.name):
        camera = model.cameras[int(model.camera_of_image[n])]
        coarse = rng.integers(0, 255, (6, 8, 3)).astype(np.uint8)
        path = tmp_path / "images" / name
        path.parent.mkdir(exist_ok=True, parents=True)
        Image.fromarray(np.asarray(cv2.resize(coarse, (camera.width, camera.height)))).save(path)
    return tmp_path


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((folder / "images").iterdir())}


def test_an_interrupted_run_continues(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = contents(undistort(workspace, target=workspace / "whole"))
    assert len(whole) > 3 and len(set(whole.values())) == len(whole)
    real, count = run.undistort_image, [0]

    def counted(*given: object) -> np.ndarray:
        count[0] += 1
        if count[0] == 3:
            raise KeyboardInterrupt
        return real(*given)

    monkeypatch.setattr(run, "undistort_image", counted)
    with pytest.raises(KeyboardInterrupt):
        undistort(workspace, target=workspace / "out", executor="inline")
    assert len(list((workspace / "out" / "units").iterdir())) == 2
    (workspace / "out" / "units" / "notes.txt").write_text("mine")
    count[0] = 3
    assert contents(undistort(workspace, target=workspace / "out", executor="inline")) == whole
    assert count[0] - 3 == len(whole) - 2
    assert [path.name for path in (workspace / "out" / "units").iterdir()] == ["notes.txt"]


@in_whole_run
def test_a_cluster_writes_the_same_files(workspace: Path) -> None:
    pytest.importorskip("distributed")
    whole = contents(undistort(workspace, target=workspace / "whole"))
    there = workspace / "there"
    main(["undistort", str(workspace), str(there), "--cluster", "local:2", "--no-shared-folder"])
    assert contents(there) == whole and not (there / "units").exists()
