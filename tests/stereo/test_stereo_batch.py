"""Folders of pairs and stereo video; pairs of a model; what is wrong with one does not stop the others."""

import json

import cv2
import numpy as np
import pytest
from PIL import Image

from epipole import api
from epipole.cameras import Camera
from epipole.disparity_search.search import match_stereo
from epipole.errors import ConfigError, DegenerateGeometryError, FileFormatError
from epipole.geometry import Rigid3
from epipole.io.colmap.model import write_colmap_model
from epipole.io.images.depth_maps import read_pfm
from epipole.pipelines.stereo.config import StereoConfig
from epipole.pipelines.stereo.pairs import list_pairs
from epipole.pipelines.stereo.run import stereo_many, stereo_of_model
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, RectifiedRig, Rigs, Tracks
from epipole.synthetic.stereo_rooms import stereo_room

CONFIG = StereoConfig(max_disparity_px=40, max_frames=3)


@pytest.fixture(scope="module")
def pair():
    return stereo_room(8, (200, 150))


def saved(folder, image):
    folder.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(folder)


def test_a_folder_with_a_corrupt_picture_goes_on(tmp_path, pair):
    for name in ("a.png", "b.png", "c.png"):
        saved(tmp_path / "left" / name, pair.left)
        saved(tmp_path / "right" / name, pair.right)
    data = (tmp_path / "right" / "b.png").read_bytes()
    (tmp_path / "right" / "b.png").write_bytes(data[: len(data) // 2])
    rig = RectifiedRig(pair.camera.K[0, 0], pair.camera.K[0, 2], pair.camera.K[1, 2], pair.baseline)
    seen = []
    out = tmp_path / "out"
    batch = stereo_many(tmp_path / "left", tmp_path / "right", out, CONFIG, rig, seen.append)
    assert batch.done == ("a", "c") and list(batch.problems) == ["b"] and "b.png" in batch.problems["b"]
    assert [p.done for p in seen] == [1, 2, 3]
    np.testing.assert_array_equal(read_pfm(out / "a" / "depth.pfm"), read_pfm(out / "c" / "depth.pfm"))
    assert json.loads((out / "summary.json").read_text())["done"] == ["a", "c"]
    # Again: nothing is measured twice, and the mended image is.
    (tmp_path / "right" / "b.png").write_bytes(data)
    again = stereo_many(tmp_path / "left", tmp_path / "right", out, CONFIG, rig)
    assert again.done == ("b",) and again.earlier == ("a", "c") and not again.problems
    saved(tmp_path / "right" / "c.png", np.roll(pair.right, 1, axis=1))
    changed = stereo_many(tmp_path / "left", tmp_path / "right", out, CONFIG, rig)
    assert changed.done == ("c",) and changed.earlier == ("a", "b")
    given = json.loads((out / "summary.json").read_text())
    assert set(given["known"]) == {"a", "b", "c"} and given["images"]["a"][1].endswith("right/a.png")
    with pytest.raises(FileFormatError, match="several pairs"):
        api.view(out, block=False)
    other = stereo_many(tmp_path / "left", tmp_path / "right", out, StereoConfig(max_disparity_px=41), rig)
    assert len(other.done) == 3


def test_pictures_without_a_partner_are_named(tmp_path, pair):
    for name in ("left/a.png", "right/a.png", "left/b.png", "right/c.png"):
        saved(tmp_path / name, pair.left)
    batch = stereo_many(tmp_path / "left", tmp_path / "right", tmp_path / "out", CONFIG)
    assert batch.done == ("a",) and set(batch.problems) == {"b", "c"}
    assert "right/b.png" in batch.problems["b"] and "left/c.png" in batch.problems["c"]


def test_pairs_by_name_and_by_order(tmp_path, pair):
    for name in ("l1.png", "l2.png"):
        saved(tmp_path / "left" / name, pair.left)
    for name in ("r1.png", "r2.png"):
        saved(tmp_path / "right" / name, pair.right)
    pairs = list_pairs(tmp_path / "left", tmp_path / "right", tmp_path / "out", 5)
    assert [(a.name, b.name) for a, b in pairs.values()] == [("l1.png", "r1.png"), ("l2.png", "r2.png")]
    for side in ("x", "y"):
        for name in ("same.png", "same.bmp"):
            saved(tmp_path / side / name, pair.left)
    twins = list_pairs(tmp_path / "x", tmp_path / "y", tmp_path / "out", 5)
    assert sorted(twins) == ["same.bmp", "same.png"]
    saved(tmp_path / "right" / "r3.png", pair.right)
    with pytest.raises(FileFormatError, match="do not match the 2 in"):
        list_pairs(tmp_path / "left", tmp_path / "right", tmp_path / "out", 5)
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileFormatError, match="no image"):
        list_pairs(tmp_path / "empty", tmp_path / "right", tmp_path / "out", 5)
    with pytest.raises(FileFormatError, match="it is not a folder"):
        list_pairs(tmp_path / "left" / "l1.png", tmp_path / "right", tmp_path / "out", 5)


def written_video(path, frames):
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (width, height))
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()


def test_stereo_video_in_two_files_and_in_one(tmp_path, pair):
    written_video(tmp_path / "l.avi", [pair.left] * 7)
    written_video(tmp_path / "r.avi", [pair.right] * 7)
    written_video(tmp_path / "both.avi", [np.hstack([pair.left, pair.right])] * 7)
    two = stereo_many(tmp_path / "l.avi", tmp_path / "r.avi", tmp_path / "two", CONFIG)
    one = stereo_many(tmp_path / "both.avi", tmp_path / "both.avi", tmp_path / "one", CONFIG)
    assert two.done == one.done == ("frame_000000", "frame_000003", "frame_000006")
    found = read_pfm(tmp_path / "one" / "frame_000003" / "disparity.pfm")
    assert found.shape == pair.left.shape
    known = np.isfinite(found) & np.isfinite(pair.disparity_px)
    assert known.mean() > 0.5 and np.median(np.abs(found - pair.disparity_px)[known]) < 0.5
    (tmp_path / "broken.avi").write_bytes(b"nothing")
    with pytest.raises(FileFormatError, match=r"broken\.avi"):
        stereo_many(tmp_path / "broken.avi", tmp_path / "r.avi", tmp_path / "x", CONFIG)


def test_another_video_of_the_same_name_is_measured_again(tmp_path, pair):
    both = tmp_path / "both.avi"
    written_video(both, [np.hstack([pair.left, pair.right])] * 3)
    first = stereo_many(both, both, tmp_path / "out", CONFIG)
    assert len(first.done) == 3 and len(stereo_many(both, both, tmp_path / "out", CONFIG).earlier) == 3
    written_video(both, [np.hstack([255 - pair.left, 255 - pair.right])] * 3)
    again = stereo_many(both, both, tmp_path / "out", CONFIG)
    assert again.done == first.done
    image = pair.left if pair.left.ndim == 3 else pair.left[..., None]
    frame = np.asarray(Image.open(next((tmp_path / "out" / "frames" / "left").iterdir())))
    assert np.abs(frame.astype(int) - (255 - image)).mean() < 8


def written_model(folder, pair, camera: Camera):
    """A workspace with the pair's two images, the right one first."""
    saved(folder / "images" / "a.png", pair.right)
    saved(folder / "images" / "b.png", pair.left)
    saved(folder / "images" / "c.png", pair.left)
    ids = np.arange(3, dtype=np.int32)
    nan = np.full((3, 3), np.nan)
    positions = Rigid3(
        np.stack([np.eye(3), np.eye(3), nan]),
        np.stack([[-2.0, 0.0, 0.0], [0.0, 0.0, 0.0], nan[0]]),
    )
    model = Reconstruction(
        Cameras.from_list([camera]),
        Rigs.of_single_cameras(1),
        Frames(np.zeros(3, np.int32), positions, np.full(3, np.nan)),
        Images(
            ("a.png", "b.png", "c.png"), ids, np.zeros(3, np.int32), np.zeros(4, np.int64), np.zeros((0, 2))
        ),
        Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0)),
        Tracks(np.zeros(1, np.int64), np.zeros(0, np.int32), np.zeros(0, np.int32)),
    )
    write_colmap_model(model, folder / "sparse" / "0")


def test_two_pictures_of_a_model(tmp_path, pair):
    written_model(tmp_path / "w", pair, pair.camera)
    found = stereo_of_model(tmp_path / "w", "a.png", "b.png", tmp_path / "out", CONFIG)
    direct = match_stereo(pair.left, pair.right, CONFIG)
    np.testing.assert_allclose(found.disparities.disparity_px, direct.disparity_px, atol=1e-3)
    # The model's baseline is 2 where the room's is some other number: depth comes in the model's unit.
    expected = 2.0 * pair.camera.K[0, 0] / found.disparities.disparity_px
    known = np.isfinite(found.depths.depth)
    assert known.mean() > 0.5
    np.testing.assert_allclose(found.depths.depth[known], expected[known], rtol=1e-4)
    assert found.unit == "the model's unit"
    for second, words in (
        ("c.png", r"c\.png is not registered in the model in .*/w$"),
        ("b", r"b is not registered .*mean b\.png\?"),
    ):
        with pytest.raises(ConfigError, match=words):
            stereo_of_model(tmp_path / "w", "a.png", second, tmp_path / "out", CONFIG)
    with pytest.raises(DegenerateGeometryError, match="must differ"):
        stereo_of_model(tmp_path / "w", "a.png", "a.png", tmp_path / "out", CONFIG)
