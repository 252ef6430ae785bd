"""Frames out of videos."""

import json

import cv2
import numpy as np
import pytest

from epipole.errors import ConfigError, FileFormatError
from epipole.io.images.photographs import list_photographs, read_gray
from epipole.io.images.video import extract_frames, is_video, sharpness, slot_bounds

FPS, SIZE = 20.0, (160, 120)


def write_video(path, num_frames=80, sharp=lambda index: True, fourcc="MJPG"):
    """A texture whose mean brightness tells the frame number; frames that are not sharp are blurred."""
    texture = cv2.resize(
        np.random.default_rng(0).integers(0, 100, (30, 40), dtype=np.uint8), SIZE, interpolation=0
    )
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*fourcc), FPS, SIZE)
    assert writer.isOpened()
    for index in range(num_frames):
        frame = texture if sharp(index) else cv2.GaussianBlur(texture, (0, 0), 4)
        writer.write(cv2.cvtColor(frame + np.uint8(index), cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def decoded_means(path):
    """Mean brightness of every frame of a video."""
    capture, means = cv2.VideoCapture(str(path)), []
    while (frame := capture.read()[1]) is not None:
        means.append(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY).mean())
    return np.array(means)


@pytest.mark.parametrize(("suffix", "fourcc"), [("avi", "MJPG"), ("mp4", "mp4v")])
def test_evenly_spaced_frames_with_times(tmp_path, suffix, fourcc):
    video = write_video(tmp_path / f"v.{suffix}", fourcc=fourcc)
    seen = []
    frames = extract_frames(video, tmp_path / "out", max_frames=8, progress=lambda *at: seen.append(at))
    assert len(frames) == 8
    assert np.abs(frames.index - (np.arange(8) * 10 + 5)).max() <= 3
    np.testing.assert_allclose(frames.timestamp_s, frames.index / FPS, atol=1e-3)
    assert frames.name == tuple(f"frame_{i:06d}.jpg" for i in frames.index)
    assert list_photographs(tmp_path / "out").names == frames.name
    decoded = decoded_means(video)
    for name, index in zip(frames.name, frames.index):
        assert np.argmin(np.abs(decoded - read_gray(tmp_path / "out" / name).mean())) == index
    assert [done for done, _ in seen] == [0, *(int(i) + 1 for i in frames.index)]
    assert {total for _, total in seen} == {80}


def test_the_sharpest_frame_of_each_window_is_taken(tmp_path):
    sharp = {3, 16, 23, 37, 44, 56, 63, 77}
    video = write_video(tmp_path / "v.avi", sharp=lambda index: index in sharp)
    frames = extract_frames(video, tmp_path / "out", max_frames=8)
    assert set(frames.index.tolist()) == sharp


def test_spacing_in_seconds_and_its_limit(tmp_path):
    video = write_video(tmp_path / "v.avi")
    spaced = extract_frames(video, tmp_path / "a", every_s=0.5)
    assert len(spaced) == 8
    limited = extract_frames(video, tmp_path / "b", every_s=0.05, max_frames=5)
    assert len(limited) == 5
    assert len(extract_frames(video, tmp_path / "tiny", every_s=5e-324, max_frames=5)) == 5
    assert limited.index[-1] > 60
    everything = extract_frames(video, tmp_path / "c", max_frames=1000)
    np.testing.assert_array_equal(everything.index, np.arange(80))
    one = extract_frames(video, tmp_path / "d", every_s=60.0)
    assert len(one) == 1


def test_a_second_call_reads_nothing_and_other_options_replace_the_frames(tmp_path):
    video, out = write_video(tmp_path / "v.avi"), tmp_path / "out"
    first = extract_frames(video, out, max_frames=8)
    (out / "mine.jpg").write_bytes(b"x")
    marked = out / first.name[0]
    marked.write_bytes(b"marked")
    again = extract_frames(video, out, max_frames=8)
    assert marked.read_bytes() == b"marked"
    assert again.name == first.name
    np.testing.assert_array_equal(again.index, first.index)
    np.testing.assert_array_equal(again.timestamp_s, first.timestamp_s)

    fewer = extract_frames(video, out, max_frames=3)
    assert {p.name for p in out.iterdir()} == {*fewer.name, "mine.jpg", "frames.json"}
    (out / fewer.name[1]).unlink()
    assert extract_frames(video, out, max_frames=3).name == fewer.name
    assert (out / fewer.name[1]).is_file()
    (out / "frames.json").write_text("{ damaged")
    assert extract_frames(video, out, max_frames=3).name == fewer.name
    assert json.loads((out / "frames.json").read_text())["request"]["max_frames"] == 3


def test_frames_appear_whole_or_not_at_all(tmp_path):
    """What a stopped call has taken is not mixed with what another number of frames takes."""
    video, out = write_video(tmp_path / "v.avi"), tmp_path / "out"

    def stop(done, total):
        if done > 30:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        extract_frames(video, out, max_frames=8, progress=stop)
    assert [p.name for p in tmp_path.iterdir()] == ["v.avi"]
    frames = extract_frames(video, out, max_frames=3)
    with pytest.raises(KeyboardInterrupt):
        extract_frames(video, out, max_frames=8, progress=stop)
    assert {p.name for p in out.iterdir()} == {*frames.name, "frames.json"}


def test_damaged_videos(tmp_path):
    (tmp_path / "text.mp4").write_text("this is no video " * 50)
    (tmp_path / "empty.mp4").write_bytes(b"")
    mp4 = write_video(tmp_path / "whole.mp4", fourcc="mp4v").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(mp4[: len(mp4) // 2])
    for name in ("text.mp4", "empty.mp4", "cut.mp4"):
        with pytest.raises(FileFormatError, match=rf"{name}.*not a (readable )?video"):
            extract_frames(tmp_path / name, tmp_path / "out")
    with pytest.raises(FileFormatError, match="it does not exist"):
        extract_frames(tmp_path / "missing.mp4", tmp_path / "out")
    avi = write_video(tmp_path / "whole.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(avi[: len(avi) // 4])
    with pytest.raises(FileFormatError, match=r"cut\.avi"):
        extract_frames(tmp_path / "cut.avi", tmp_path / "out2", max_frames=8)
    assert not (tmp_path / "out2" / "frames.json").exists()


@pytest.mark.parametrize("options", [{"max_frames": 0}, {"every_s": 0.0}, {"every_s": float("nan")}])
def test_useless_options(tmp_path, options):
    with pytest.raises(ConfigError, match="must be"):
        extract_frames(tmp_path / "v.avi", tmp_path / "out", **options)


def test_is_video(tmp_path):
    for name in ("a.MP4", "b.mov", "c.jpg"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "d.mp4").mkdir()
    assert [is_video(tmp_path / n) for n in ("a.MP4", "b.mov", "c.jpg", "d.mp4", "e.mp4")] == [True, True] + [
        False
    ] * 3


@pytest.mark.parametrize(
    ("num_frames", "num_slots"), [(1, 1), (80, 80), (80, 8), (81, 7), (1000, 3), (10, 9)]
)
def test_windows_are_in_order_disjoint_and_inside(num_frames, num_slots):
    first, last = slot_bounds(num_frames, num_slots).T
    assert len(first) == num_slots
    assert (first <= last).all()
    assert first[0] >= 0
    assert last[-1] < num_frames
    assert (first[1:] > last[:-1]).all()
    slots = num_frames / num_slots
    assert np.abs(0.5 * (first + last) + 0.5 - (np.arange(num_slots) + 0.5) * slots).max() <= 1.0


def test_sharpness_is_the_variance_of_the_laplacian():
    gray = np.random.default_rng(1).integers(0, 256, (40, 50), dtype=np.uint8)
    padded = np.pad(gray.astype(float), 1, mode="reflect")
    laplacian = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:] - 4.0 * gray
    assert sharpness(gray) == pytest.approx(laplacian.var(), rel=1e-4)
    assert sharpness(cv2.GaussianBlur(gray, (0, 0), 2)) < 0.1 * sharpness(gray)
