"""Tags, boards and clicked lengths make one camera's path metric, from a folder of images to the summary."""

import json

import cv2
import numpy as np
import pytest
from slam_rides import CAMERA, position

from epipole.cli.main import main
from epipole.geometry import Rigid3, align_points
from epipole.io import read_trajectory
from epipole.pipelines.slam.run import slam as run_slam
from epipole.synthetic import SyntheticScene, courtyard, render
from epipole.synthetic.markers import chessboard_sheet, tag_sheet
from whole import IS_WHOLE, in_whole_run

COUNT = 24
TAG, BOARD, SQUARE = (-0.5, 1.6, 1.75), (0.8, 1.5, 1.4), 0.15
LENS = "260,260,160,120"
GIVEN = {"camera_params": LENS, "fps": 10.0}
COLUMNS = ("kind", "params", "texture", "color", "seed")


@pytest.fixture(scope="module")
def cams_from_world():
    positions = [position(n, "arc") for n in range(COUNT)]
    return Rigid3(np.stack([p.rotation for p in positions]), np.stack([p.translation for p in positions]))


@pytest.fixture(scope="module")
def images(tmp_path_factory, cams_from_world):
    """The ride past the courtyard, in which a tag of half a meter and a chessboard stand."""
    axes = (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)
    sheets = SyntheticScene.of(tag_sheet(7, 0.5, TAG, *axes) + chessboard_sheet(6, 4, SQUARE, BOARD, *axes))
    yard = courtyard()
    both = (np.concatenate([getattr(yard, name), getattr(sheets, name)]) for name in COLUMNS)
    scene, folder = SyntheticScene(*both, yard.light), tmp_path_factory.mktemp("known") / "pictures"
    folder.mkdir()
    for n in range(COUNT):
        image = render(scene, CAMERA, cams_from_world[n], noise_sigma=1.5, seed=n)
        cv2.imwrite(str(folder / f"{n:03d}.png"), cv2.cvtColor(image.rgb, cv2.COLOR_RGB2GRAY))
    return folder


def check(out, cams_from_world, words):
    """The summary says what fixed the scale; the truth is within 2 % and two of the stated deviations."""
    summary, path = json.loads((out / "summary.json").read_text()), read_trajectory(out / "trajectory.txt")
    assert summary["is_metric"] and summary["num_localized"] == COUNT
    assert summary["scale"].startswith(f"meters, from {words}: known to ")
    assert [e["kept"] for e in summary["anchor"]["estimates"]] == [True]
    assert summary["scale"] in (out / "report.html").read_text(encoding="utf-8")
    true = cams_from_world.centers()[np.rint(10 * path.timestamp_s).astype(int)]
    length = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    assert path.path_length() == pytest.approx(length, rel=0.02)
    off = np.log(float(align_points(path.world_from_body.translation, true).scale))
    assert abs(off) < 2 * summary["anchor"]["relative_sigma"] < 0.03


@pytest.mark.usefixtures("unchecked")
def test_a_tag(images, cams_from_world, tmp_path, capsys):
    main(["slam", str(images), str(tmp_path), "--camera-params", LENS, "--fps", "10", "--tag-size-m", "0.5"])
    check(tmp_path, cams_from_world, "tag 7")
    shown = " ".join(capsys.readouterr().out.split())
    assert "scale meters, from tag 7" in shown and "not meters" not in shown


@in_whole_run
@pytest.mark.usefixtures("unchecked")
def test_a_chessboard(images, cams_from_world, tmp_path):
    run_slam(images, tmp_path, board="6x4", square_m=SQUARE, **GIVEN)
    check(tmp_path, cams_from_world, "the board of 6x4")


@pytest.mark.usefixtures("unchecked")
def test_a_length_clicked_in_two_pictures(images, cams_from_world, tmp_path):
    ends = np.array([[TAG[0] - 0.25, TAG[1], TAG[2]], [BOARD[0] + 3.5 * SQUARE, BOARD[1], BOARD[2]]])
    lines = ["# name meters end image x y"]
    for end, there in zip("ab", ends, strict=True):
        for n in (2, COUNT - 2):
            x, y = CAMERA.project(cams_from_world[n].apply(there[None]))[0]
            lines.append(f"shelf {np.linalg.norm(ends[0] - ends[1])} {end} {n:03d}.png {x:.1f} {y:.1f}")
    (tmp_path / "lengths.txt").write_text("\n".join(lines))
    run_slam(images, tmp_path / "out", lengths=tmp_path / "lengths.txt", clicks_sigma_px=0.3, **GIVEN)
    check(tmp_path / "out", cams_from_world, "length shelf")


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("known", "words"),
    [
        ({"tag_size_m": 0.5, "tag_family": "25h9"}, "no 25h9 tag was detected in the "),
    ]
    + IS_WHOLE * [({"board": "9x7", "square_m": 0.1}, "the board of 9x7: it was detected in none of the ")],
)
def test_what_is_not_in_the_scene_leaves_the_path_up_to_scale(images, tmp_path, known, words):
    result = run_slam(images, tmp_path, **known, **GIVEN)
    assert not result.summary["is_metric"] and result.summary["scale"].startswith("up to scale")
    assert "anchor" not in result.summary
    assert [w for w in result.warnings if words in w and w.startswith("the trajectory remains up to scale: ")]
    assert any(words in w for w in json.loads((tmp_path / "summary.json").read_text())["warnings"])
