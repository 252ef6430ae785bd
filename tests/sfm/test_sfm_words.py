"""What a run says while it works and when it is done."""

import json

import cv2
import numpy as np
import pytest
from photographs import CAMERA, HEIGHT, WIDTH

from epipole import reconstruct
from epipole.io.images.photographs import read_rgb
from epipole.pipelines.sfm.matching import pair_blocks
from epipole.pipelines.sfm.notes import title_of


@pytest.fixture(scope="module")
def given(rendered, tmp_path_factory):
    """Five images without EXIF, and two of noise; with few blocks of pairs. Result, progress, folder."""
    folder = tmp_path_factory.mktemp("words") / "garden" / "images"
    folder.mkdir(parents=True)
    for path in sorted(rendered.iterdir())[:5]:
        cv2.imwrite(str(folder / path.name), read_rgb(path)[..., ::-1])
    for n in range(2):
        noise = np.random.default_rng(n).integers(0, 255, (HEIGHT // 4, WIDTH // 4, 3)).astype(np.uint8)
        cv2.imwrite(str(folder / f"z{n}.png"), cv2.resize(noise, (WIDTH, HEIGHT // 2)))
    reports = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pair_blocks, "MOST_BLOCKS", 2)
        result = reconstruct(folder, folder.parent.parent / "out", progress=reports.append)
    return result, reports, folder


def last(reports, stage):
    return [(r.done, r.total) for r in reports if r.stage == stage][-1]


def test_progress_counts_pairs_and_pictures_to_the_end(given):
    result, reports, _ = given
    assert last(reports, "match") == last(reports, "verify") == (21, 21)
    assert last(reports, "features") == (7, 7)
    assert last(reports, "map") == (sum(m.is_registered().sum() for m in result.models), 7)
    for r in reports:
        assert 0 <= r.done <= r.total


def test_focal_lengths_are_said_of_pictures_with_their_final_values(given):
    result, _, _ = given
    (note,) = [w for w in result.warnings if "focal length" in w]
    final_px = result.model.cameras[0].focal_px
    assert note.startswith("focal length estimated from the images: view_00.jpg and 4 others: ")
    assert f": {final_px:.0f} px" in note
    assert abs(final_px - CAMERA.focal_px) < 0.1 * CAMERA.focal_px


def test_where_focal_lengths_come_from(given, tmp_path, reconstructed):
    result, _, folder = given
    (source,) = result.summary["focal_sources"][:1]
    assert source == "estimated from the images (assumed 1.2 x the longer side at first)"
    for path in sorted(folder.iterdir())[:2]:  # two images: nothing can be found from their pair alone
        (tmp_path / "two").mkdir(exist_ok=True)
        (tmp_path / "two" / path.name).write_bytes(path.read_bytes())
    two = reconstruct(tmp_path / "two", tmp_path / "out")
    is_found = "estimated from the images" in two.summary["focal_sources"][0]
    assert is_found != any("the focal length is unknown" in w for w in two.warnings)
    assert reconstructed.summary["focal_sources"] == ["EXIF, 35 mm equivalent, then refined with the model"]
    assert not any("focal" in w for w in reconstructed.warnings)


def test_the_report_has_the_name_of_the_source_and_says_things_once(given):
    _, _, folder = given
    page = (folder.parent.parent / "out" / "report.html").read_text(encoding="utf-8")
    assert "<h1>garden</h1>" in page
    assert page.count("2 of 7 images") == 1
    assert "view_00.jpg and 4 others: " in page
    summary = json.loads((folder.parent.parent / "out" / "summary.json").read_text())
    assert "2 of 7 images are in no model" in summary["warnings"]


def test_names_of_sources(tmp_path):
    for name in ("house", "tower/images", "lake/rgb/frames"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "ride.mp4").write_bytes(b"")
    found = [title_of(tmp_path / name) for name in ("house", "tower/images", "lake/rgb/frames", "ride.mp4")]
    assert found == ["house", "tower", "lake", "ride"]
