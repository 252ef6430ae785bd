"""Lists, depth and images that are wrong: said in clear words, and the path that can be known is kept."""

from functools import partial

import cv2
import numpy as np
import pytest
from slam_rides import CAMERA, MONO, ride, write_pairs

from epipole.errors import FileFormatError, NoModelError
from epipole.geometry import Rigid3
from epipole.io import read_sequence
from epipole.pipelines.slam import run
from epipole.pipelines.slam.frames import Frame
from epipole.pipelines.slam.run import slam as run_slam
from epipole.pipelines.slam.sources.depth_range import DepthRange
from epipole.pipelines.slam.sources.folder import FrameSource, QueuedFrame

PARAMS = ",".join(str(p + 0.5 * (n >= 2)) for n, p in enumerate(CAMERA.params))
KNOWN = {"camera_params": PARAMS}
COUNT = 10


def raised(error):
    raise error


def tum_folder(folder, unit=5000.0, lines=None):
    """The first frames of the ride as a TUM RGB-D folder."""
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for n in range(COUNT):
        cv2.imwrite(str(folder / "rgb" / f"{n}.png"), ride().left[n])
        numbers = np.clip(np.rint(unit * ride().depth[n]), 0, 65535)
        cv2.imwrite(str(folder / "depth" / f"{n}.png"), numbers.astype(np.uint16))
    rows = range(COUNT) if lines is None else lines
    (folder / "rgb.txt").write_text("".join(f"{0.1 * n:.3f} rgb/{n}.png\n" for n in rows))
    (folder / "depth.txt").write_text("".join(f"{0.1 * n:.3f} depth/{n}.png\n" for n in range(COUNT)))
    return folder


def test_a_list_out_of_order_and_with_doubled_times(tmp_path):
    folder = tum_folder(tmp_path / "room", lines=[3, 0, 1, 2, 4, 4, 6, 5, 7, 8, 9])
    result = run_slam(folder, tmp_path / "out", **KNOWN)
    assert result.summary["num_localized"] == COUNT
    assert set(result.warnings) == {
        "rgb.txt: 2 lines are earlier than the previous line, and were sorted",
        "rgb.txt: 1 lines repeat a time; only the first of each is used",
    }


def test_the_first_of_a_doubled_time_is_taken(tmp_path):
    folder = tum_folder(tmp_path / "room")
    with (folder / "rgb.txt").open("a") as file:
        file.write("0.500 rgb/0.png\n")
    frames = read_sequence(folder).frames
    assert [frame.image.stem for frame in frames] == [str(n) for n in range(COUNT)]


def test_a_list_of_euroc_out_of_order(tmp_path, data_dir):
    import shutil

    shutil.copytree(data_dir / "slam" / "euroc_static", tmp_path / "drone")
    path = next((tmp_path / "drone").rglob("cam0/data.csv"))
    header, *rows = path.read_text().splitlines()
    path.write_text("\n".join([header, *reversed(rows), rows[0].strip()]) + "\n")
    found = read_sequence(tmp_path / "drone")
    assert (np.diff([frame.timestamp_s for frame in found.frames]) > 0).all() and len(found) == 6
    late, doubled = found.warnings
    assert late.startswith(f"cam0/data.csv: {len(rows) - 1} lines are earlier")
    assert "1 lines repeat a time" in doubled


@pytest.mark.parametrize(
    ("factor", "is_given"), [(1.0, False), (10.0, True), (0.05, True), (1000.0, True), (0.001, True)]
)
def test_depth_in_a_wrong_unit_is_told(factor, is_given):
    """Registered depth that is too long by a factor agrees with the images: only its range tells."""
    ranges = DepthRange()
    for depth in ride().depth[:3]:
        ranges.add((factor * depth).astype(np.float32))
    ranges.add(np.zeros((24, 32), np.float32))
    assert bool(ranges.notes()) == is_given
    assert not is_given or "the unit" in ranges.notes()[0]
    assert DepthRange().notes() == []


def test_depth_in_a_wrong_unit_is_told_beside_the_path(tmp_path):
    """Meters times 50 in a file that has 5000 for a meter."""
    result = run_slam(tum_folder(tmp_path / "room", unit=50.0), tmp_path / "out", **KNOWN)
    assert result.summary["num_localized"] > 0
    (warning,) = (w for w in result.warnings if "median depth" in w)
    assert "0.05 to 100 m" in warning


def test_depth_pictures_of_another_size(tmp_path):
    folder = tum_folder(tmp_path / "room")
    cv2.imwrite(str(folder / "depth" / "4.png"), np.full((60, 80), 5000, np.uint16))
    result = run_slam(folder, tmp_path / "out", **KNOWN)
    assert result.summary["num_localized"] == COUNT - 1
    (warning,) = result.warnings
    assert warning.startswith("frame 4 is left out: the depth is 80 x 60, but the depth camera is 320 x 240")
    assert "registered depth has the size of the image" in warning
    for n in range(COUNT):
        cv2.imwrite(str(folder / "depth" / f"{n}.png"), np.full((60, 80), 5000, np.uint16))
    with pytest.raises(NoModelError, match="the depth is 80 x 60"):
        run_slam(folder, tmp_path / "none", **KNOWN)


def test_pictures_that_change_size_before_they_are_undistorted(tmp_path):
    folder = tum_folder(tmp_path / "room")
    bent = {"camera_model": "OPENCV", "camera_params": f"{PARAMS},0.01,0,0,0"}
    cv2.imwrite(str(folder / "rgb" / "3.png"), np.zeros((60, 80), np.uint8))
    (folder / "rgb" / "6.png").write_bytes((folder / "rgb" / "6.png").read_bytes()[:700])
    result = run_slam(folder, tmp_path / "out", **bent)
    assert result.summary["num_localized"] == COUNT - 2
    assert [w.split(":")[0] for w in result.warnings] == ["frame 3 is left out", "frame 6 is left out"]


def test_pictures_of_a_distorted_lens_with_depth(tmp_path):
    """TUM's freiburg1 and 2 are so. What is registered to an image has its distortion: here next to none."""
    bent = {"camera_model": "OPENCV", "camera_params": f"{PARAMS},1e-4,0,0,0"}
    result = run_slam(tum_folder(tmp_path / "room"), tmp_path / "out", **bent)
    path = result.trajectory.world_from_body
    assert result.summary["num_localized"] == COUNT and not result.warnings
    assert np.linalg.norm(path.translation - ride().truth().translation[:COUNT], axis=1).max() < 0.02


def test_a_pair_whose_pictures_change_size_before_they_are_rectified(tmp_path):
    f, _, cx, cy = CAMERA.params
    for name, images in (("image_0", ride().left), ("image_1", ride().right)):
        (tmp_path / "ride" / name).mkdir(parents=True)
        for n, image in enumerate(images[:COUNT]):
            small = cv2.resize(image, (160, 120)) if (n, name) == (4, "image_1") else image
            cv2.imwrite(str(tmp_path / "ride" / name / f"{n:06d}.png"), small)
    # Other focal lengths of the two make the pair one that is rectified.
    rows = [[f, 0, cx, 0, 0, f, cy, 0, 0, 0, 1, 0], [f + 0.01, 0, cx, -f * 0.12, 0, f, cy, 0, 0, 0, 1, 0]]
    text = "".join(f"P{k}: {' '.join(map(str, row))}\n" for k, row in enumerate(rows))
    (tmp_path / "ride" / "calib.txt").write_text(text)
    result = run_slam(tmp_path / "ride", tmp_path / "out")
    assert result.summary["num_localized"] == COUNT - 1
    assert [w.split(":")[0] for w in result.warnings] == ["frame 4 is left out"]


def test_a_folder_whose_pictures_end_before_its_list(tmp_path):
    """A copy that was not finished: the last images are not there, the one before is cut off."""
    folder = tum_folder(tmp_path / "room")
    for n in (7, 8, 9):
        (folder / "rgb" / f"{n}.png").unlink()
    (folder / "rgb" / "6.png").write_bytes((folder / "rgb" / "6.png").read_bytes()[:900])
    result = run_slam(folder, tmp_path / "out", **KNOWN)
    assert result.summary["num_localized"] == 6
    assert [w.split(":")[0] for w in result.warnings] == [f"frame {n} is left out" for n in range(6, 10)]
    (folder / "rgb" / "0.png").unlink()
    with pytest.raises(FileFormatError, match=r"0\.png"):
        run_slam(folder, tmp_path / "none", **KNOWN)


def test_a_pair_whose_second_camera_ends_first(tmp_path):
    folder = write_pairs(tmp_path / "ride", COUNT)
    for n in (8, 9):
        (folder / "image_1" / f"{n:06d}.png").unlink()
    result = run_slam(folder, tmp_path / "out")
    assert result.summary["num_localized"] == 8
    assert [w.split(":")[0] for w in result.warnings] == ["frame 8 is left out", "frame 9 is left out"]


@pytest.mark.parametrize(
    ("odd", "words"),
    [
        (lambda: Frame(0.25, ride().left[4]), "timestamps must increase"),
        (lambda: Frame(0.4, ride().left[4][::2, ::2].copy()), "160 x 120"),
        (lambda: raised(FileFormatError("4.png", "is damaged")), "is damaged"),
    ],
    ids=["a clock set back", "another size", "damaged"],
)
def test_a_camera_that_stumbles(odd, words, tmp_path, monkeypatch):
    """A frame that cannot be used is left out, and told."""

    def read(n, frame):
        return odd() if n == 4 else frame

    def frames():
        for n, frame in enumerate(ride().frames("mono")[:COUNT]):
            yield QueuedFrame(n, frame.timestamp_s, f"{n}.png", partial(read, n, frame))

    source = FrameSource(MONO, COUNT, frames, Rigid3.identity(), is_live=True)
    monkeypatch.setattr(run, "find_camera", lambda *_: None)
    monkeypatch.setattr(run, "_open", lambda *_: source)
    (tmp_path / "camera").mkdir()
    result = run_slam(tmp_path / "camera", tmp_path / "out", mapping="inline")
    assert result.summary["num_localized"] == COUNT - 1
    (warning,) = result.warnings
    assert warning.startswith("frame 4 is left out: ") and words in warning
