"""The benchmark's own arithmetic: medians, pairs, the better mapper, stripped EXIF, the robust GPS fit."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.gps import align_robustly
from benchmarks.measure import run_measured
from benchmarks.peers.base import Limits
from benchmarks.peers.epipole_sfm import EpipoleSfm
from benchmarks.peers.pycolmap_sfm import PycolmapSfm
from benchmarks.sfm import best_mapper, paired_ratios, summarize
from benchmarks.tasks.sfm import SETS, SfmTask, data_root, prepare, strip_exif
from PIL import Image

from epipole.geometry import Similarity3


def run(number: int, wall_s: float, exit_code: int = 0, **score: float) -> dict[str, Any]:
    return {"run": number, "exit_code": exit_code, "wall_s": wall_s, "peak_memory_mb": None, "score": score}


def test_summary_is_median_and_range_of_runs_that_ended_well() -> None:
    runs = [run(0, 4.0, points=10), run(1, 1.0, points=30), run(2, 2.0, points=20), run(3, 99.0, exit_code=1)]
    out = summarize(runs)
    assert out["wall_s"] == {"median": 2.0, "min": 1.0, "max": 4.0}
    assert out["points"] == {"median": 20, "min": 10, "max": 30}
    assert "peak_memory_mb" not in out and "auc_1" not in out


def test_ratios_are_between_runs_of_the_same_number() -> None:
    ours, theirs = [run(0, 10.0), run(1, 1.0), run(2, 7.0)], [run(1, 2.0), run(0, 10.0)]
    assert paired_ratios(ours, theirs)["wall_s"] == {"median": 0.75, "min": 0.5, "max": 1.0}


def test_better_mapper_has_more_images_then_nearer_ones_then_more_observations() -> None:
    few, near = run(0, 1.0, registered=5, position_mean=0.1), run(0, 9.0, registered=6, position_mean=0.2)
    far = run(0, 1.0, registered=6, position_mean=0.3)
    assert best_mapper([few, far, near]) is near
    rich, poor = run(0, 9.0, registered=6, observations=9), run(0, 1.0, registered=6, observations=8)
    assert best_mapper([poor, rich]) is rich
    assert best_mapper([run(0, 1.0, exit_code=1, registered=9)]) is None


def test_stripping_exif_keeps_every_pixel() -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (40, 56, 3), dtype=np.uint8)
    exif, stream = Image.Exif(), io.BytesIO()
    exif[0x010F] = "maker"
    Image.fromarray(pixels).save(stream, "JPEG", exif=exif, comment=b"words")
    bare = strip_exif(stream.getvalue())
    before, after = Image.open(io.BytesIO(stream.getvalue())), Image.open(io.BytesIO(bare))
    assert dict(before.getexif()) and not dict(after.getexif()) and "comment" not in after.info
    assert np.array_equal(np.asarray(before), np.asarray(after))
    with pytest.raises(ValueError, match="JPEG"):
        strip_exif(b"not an image")


def test_robust_fit_is_not_moved_by_wrong_fixes() -> None:
    rng = np.random.default_rng(1)
    source = rng.normal(size=(20, 3))
    truth = Similarity3.exp([5.0, 1, 0, 0.3, -0.2, 2.0, 1.2])
    target = truth.apply(source)
    target[:7] += rng.normal(size=(7, 3)) * 30
    found = align_robustly(source, target)
    assert found is not None
    assert np.abs((found @ truth.inverse()).log()).max() < 1e-9
    assert align_robustly(source[:2], target[:2]) is None


def test_a_run_is_measured_from_start_to_end(tmp_path: Path) -> None:
    pytest.importorskip("psutil")
    fixed = run_measured(["bash", "-c", "sleep 0.4; echo done; exit 3"], tmp_path / "log", 1)
    assert fixed.exit_code == 3 and 0.4 <= fixed.wall_s < 5
    assert fixed.peak_memory_mb is not None and 0.5 < fixed.peak_memory_mb < 100
    assert (tmp_path / "log").read_text() == "done\n"


def test_commands_tell_every_program_the_same_calibration(tmp_path: Path) -> None:
    task = SfmTask("a", tmp_path, ("0.jpg",), "calibration", "PINHOLE", (700.5, 701.0, 320.0, 240.5))
    peers = [EpipoleSfm(), PycolmapSfm("incremental"), PycolmapSfm("global", "pycolmap-incremental")]
    for peer in peers:
        command = peer.command(task, tmp_path / peer.name, Limits())
        assert command[command.index("--camera-params") + 1] == "700.5,701.0,320.0,240.5"
        assert command[command.index("--camera-model") + 1] == "PINHOLE"
    assert str(tmp_path / "pycolmap-incremental" / "database.db") in command


@pytest.mark.parametrize("name", SETS)
def test_every_set_is_there_and_has_its_pictures(name: str, tmp_path: Path) -> None:
    if not (data_root() / "sfm").is_dir():
        pytest.skip(f"no data under {data_root().name}/sfm")
    task = prepare(name, data_root(), tmp_path)
    assert len(task.image_names) >= 8
    assert all((task.images / image).is_file() for image in task.image_names)
    if task.truth is not None:
        assert task.truth.exists() and task.unit
    if task.known == "nothing":
        assert task.camera_params is None
        assert sorted(p.name for p in task.images.iterdir()) == sorted(task.image_names)


def test_missing_data_are_said(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="EPIPOLE_DATA"):
        prepare("lund_gps", tmp_path, tmp_path)
