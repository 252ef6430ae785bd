"""What the reconstruction of an unknown camera has lost is repeated by SLAM, under the names of the source."""

from types import SimpleNamespace

import cv2
import numpy as np
from slam_rides import CAMERA

from epipole.pipelines.slam.config import CameraOptions, JobOptions
from epipole.pipelines.slam.sources import intrinsics as found_camera
from epipole.runs import ignore_progress


def test_losses_have_the_names_of_the_source(tmp_path, monkeypatch):
    random, taken = np.random.default_rng(0), []
    for n in range(12):
        cv2.imwrite(
            str(tmp_path / f"shot_{7 * n:03d}.png"), random.integers(0, 255, (48, 64, 3), dtype=np.uint8)
        )

    def reconstruct(folder, out, **_):
        taken.extend(sorted(path.name for path in folder.iterdir()))
        reasons = {taken[1]: "no overlap", taken[4]: "is truncated"}
        warnings = [f"2 of {len(taken)} images are in no model", f"focal length of {taken[0]}"]
        return SimpleNamespace(summary={"warnings": warnings, "models": [{}, {}], "not_registered": reasons})

    monkeypatch.setattr(found_camera, "reconstruct", reconstruct)
    monkeypatch.setattr(
        found_camera,
        "_judged",
        lambda found, losses: found_camera.FoundCamera(CAMERA, 10, 1.0, tuple(losses)),
    )
    found = found_camera.find_camera(tmp_path, JobOptions(), CameraOptions(), ignore_progress)
    said = "\n".join(found.notes())
    for words in (
        "shot_007.png is not registered: no overlap",
        "shot_028.png is not registered: is truncated",
    ):
        assert words in said
    assert "focal length of shot_000.png" in said and "2 disconnected models" in said
    assert "/tmp" not in said and "00000" not in said
    assert found.summary()["warnings"] == list(found.losses)
