"""A video replaces nothing unless it reads back as it was written."""

import resource
import shutil
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from epipole.errors import ConfigError, WorkspaceError
from epipole.io.atomic import atomic_write
from epipole.io.images import video_files
from epipole.io.images.gif_files import GifWriter, gif_problem
from epipole.io.images.video_files import write_video
from epipole.io.seals import add_seal, sealed_by
from whole import IS_WHOLE


def frames(count: int, seed: int = 0) -> list[np.ndarray]:
    return list(np.random.default_rng(seed).integers(0, 255, (count, 120, 160, 3), np.uint8))


def lengths(path: Path) -> int:
    video, count = cv2.VideoCapture(str(path)), 0
    while video.grab():
        count += 1
    return count


@pytest.fixture(params=["h264", "vp9"])
def encoder(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """PyAV, or OpenCV as where PyAV is not installed."""
    if request.param == "vp9":
        monkeypatch.setattr(video_files, "find_spec", lambda name: None)
    elif find_spec("av") is None:
        pytest.skip("PyAV is not installed")
    return request.param


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an earlier video."""
    folder = tmp_path_factory.mktemp("written")
    with atomic_write(folder / "a.mp4") as part:
        write_video(part, frames(3), 30.0)
    assert lengths(folder / "a.mp4") == 3
    return folder


@pytest.fixture
def earlier(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(written / "a.mp4", tmp_path))


@pytest.mark.parametrize("fraction", [0.02, 0.3, 0.9, 0.999] if IS_WHOLE else [0.02, 0.9])
@pytest.mark.usefixtures("encoder")
def test_a_full_disk_is_an_error_and_keeps_the_earlier_video(
    earlier: Path, fraction: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    before, complete = earlier.read_bytes(), tmp_path_factory.mktemp("complete") / "a.mp4"
    write_video(complete, frames(12, 1), 30.0)
    room = int(fraction * complete.stat().st_size)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))  # writing beyond fails, as on a full disk
    try:
        with pytest.raises(WorkspaceError, match="is the disk full"), atomic_write(earlier) as part:
            write_video(part, frames(12, 1), 30.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert earlier.read_bytes() == before
    assert sorted(path.name for path in earlier.parent.iterdir()) == ["a.mp4"]


class Writer:
    """An encoder that loses, repeats or spoils frames, and says nothing."""

    def __init__(self, inner: video_files.VideoWriter, fault: str) -> None:
        self.inner, self.fault, self.count = inner, fault, 0

    def write(self, frame: np.ndarray) -> None:
        self.count += 1
        if self.fault == "lost" and self.count == 2:
            return
        for _ in range(1 + (self.fault == "repeated" and self.count == 2)):
            self.inner.write(frame * 0 if self.fault == f"black {self.count}" else frame)

    def release(self) -> None:
        self.inner.release()


@pytest.mark.usefixtures("encoder")
@pytest.mark.parametrize("fault", ["lost", "repeated", "black 1", "black 5"])
def test_frames_are_counted_and_looked_at(fault: str, earlier: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = video_files._writer_of
    monkeypatch.setattr(video_files, "_writer_of", lambda *args: Writer(opened(*args), fault))
    before = earlier.read_bytes()
    with pytest.raises(WorkspaceError, match=r"frames? "), atomic_write(earlier) as part:
        write_video(part, frames(5, 2), 30.0)
    assert earlier.read_bytes() == before


@pytest.mark.usefixtures("encoder")
@pytest.mark.parametrize("size", [(16, 16), (17, 33), (2, 2), (481, 270)])
def test_sizes(size: tuple[int, int], tmp_path: Path) -> None:
    image = np.full((size[1], size[0], 3), (200, 30, 90), np.uint8)
    write_video(tmp_path / "a.mp4", [image], 25.0)
    read, frame = cv2.VideoCapture(str(tmp_path / "a.mp4")).read()
    assert read and lengths(tmp_path / "a.mp4") == 1
    assert frame.shape == (size[1] & ~1, size[0] & ~1, 3)
    with pytest.raises(ConfigError, match="needs at least one image"):
        write_video(tmp_path / "b.mp4", [], 25.0)


def test_the_codec_is_the_one_that_most_players_know(encoder: str, tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", frames(4), 12.5)
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    codec = int(video.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode()
    assert codec in {"h264": ("h264", "avc1"), "vp9": ("vp09", "VP90")}[encoder]
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(12.5)


def test_a_gif_has_all_frames_and_their_times(tmp_path: Path) -> None:
    shades = [np.full((31, 45, 3), value, np.uint8) for value in (10, 90, 170, 250)]
    write_video(tmp_path / "a.gif", shades, 20.0)
    with Image.open(tmp_path / "a.gif") as gif:
        assert gif.size == (45, 31) and gif.n_frames == 4
        for number, shade in enumerate(shades):
            gif.seek(number)
            assert gif.info["duration"] == 50
            np.testing.assert_allclose(np.asarray(gif.convert("RGB")), shade, atol=4)


def test_a_gif_keeps_equal_frames_and_what_did_not_change(tmp_path: Path) -> None:
    """Equal frames are not merged; of the others only the changed part is stored; delays add up to the time."""
    random = np.random.default_rng(0)
    shown = [np.kron(random.integers(0, 4, (20, 30, 3)) * 80, np.ones((4, 4, 1))).astype(np.uint8)]
    for k in range(8):
        later = shown[-1].copy()
        if k % 3:
            later[4 * k : 4 * k + 12, 8:24] = 20 * k
        shown.append(later)
    write_video(tmp_path / "a.gif", shown, 30.0)
    with Image.open(tmp_path / "a.gif") as gif:
        assert gif.n_frames == 9 and gif.size == (120, 80) and gif.info["loop"] == 0
        total_ms = 0
        for number, image in enumerate(shown):
            gif.seek(number)
            total_ms += gif.info["duration"]
            np.testing.assert_allclose(np.asarray(gif.convert("RGB")), image, atol=8)
    assert total_ms == 300


def test_the_frames_of_a_gif_are_written_one_by_one(tmp_path: Path) -> None:
    path = tmp_path / "a.gif"
    writer = GifWriter(path, 10.0, (64, 48))
    sizes = []
    for image in np.random.default_rng(0).integers(0, 255, (200, 48, 64, 3)).astype(np.uint8):
        writer.write(image)
        sizes.append(path.stat().st_size)
    assert sizes[-2] > 100_000
    writer.release()
    assert gif_problem(path, 200, np.zeros((48, 64, 3))) == ""
    assert "only 200 of 201 frames" in gif_problem(path, 201, np.zeros((48, 64, 3)))
    assert "64 x 48 pixels, not 60 x 48" in gif_problem(path, 200, np.zeros((48, 60, 3)))
    path.write_bytes(path.read_bytes()[: sizes[100]])
    assert gif_problem(path, 200, np.zeros((48, 64, 3)))


def test_a_gif_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match="cannot write"):
        write_video(tmp_path / "nowhere" / "a.gif", frames(2), 10.0)


def test_a_gif_keeps_its_seal(tmp_path: Path) -> None:
    path = tmp_path / "a.gif"
    write_video(path, frames(2), 10.0)
    add_seal(path, "render")
    assert sealed_by(path) == "render"
    with Image.open(path) as gif:
        assert gif.n_frames == 2
