"""Small files that stand for much: refused clearly, or read, in little memory and time, in a process that survives."""

import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import bombs
import pytest

from answering_process import AnsweringProcess
from whole import IS_WHOLE

pytestmark = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is limited as on Linux")

Read = Callable[..., str]
SLOW = ("MCAP of zstd that says its size", "MCAP of lz4", "ROS 1 of lz4")
"""Of the whole run: seconds each, by decompressors that other files are unpacked with in every run."""


@pytest.fixture(scope="module")
def read() -> Iterator[Read]:
    """Read a file in another process; says what became of it."""
    process = AnsweringProcess(Path(__file__).with_name("bomb_process.py"), stderr=subprocess.DEVNULL)

    def read(reader: str, *paths: Path, most_mib: int = 400) -> str:
        line = process.ask([reader, [str(path) for path in paths], most_mib], 30)
        if not line:
            return "hangs" if process.died_with is None else f"dies with {process.died_with}"
        return json.loads(line)

    yield read
    process.close()


def refuses(said: str) -> None:
    assert said.startswith("refused: ")


@pytest.mark.parametrize("what", list(bombs.YAML))
def test_yaml(read: Read, tmp_path: Path, what: str) -> None:
    path = tmp_path / "bomb.yaml"
    path.write_text(bombs.YAML[what])
    refuses(read("calibration", path))


@pytest.mark.parametrize("what", list(bombs.MATRICES))
def test_matrices_of_opencv(read: Read, tmp_path: Path, what: str) -> None:
    """A size that its values do not have is refused; OpenCV's own reader would end the process."""
    path = tmp_path / "bomb.yml"
    path.write_text(bombs.opencv("3", "3"))
    assert read("calibration", path) == "read"
    path.write_text(bombs.MATRICES[what])
    refuses(read("calibration", path))


@pytest.mark.parametrize("what", list(bombs.XML_FILES))
def test_xml(read: Read, tmp_path: Path, what: str) -> None:
    path = tmp_path / "bomb.xml"
    path.write_bytes(bombs.XML_FILES[what])
    refuses(read("calibration", path))


@pytest.mark.parametrize("what", list(bombs.IMAGES))
def test_pictures(read: Read, tmp_path: Path, what: str) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(bombs.IMAGES[what]())
    for reader in ("rgb", "gray", "small", "mask", "png16", "pfm"):
        refuses(read(reader, path, most_mib=64))
    assert read("header", path).startswith(("read", "refused"))


@pytest.mark.parametrize("what", list(bombs.BZ2))
def test_archives(read: Read, tmp_path: Path, what: str) -> None:
    path = tmp_path / "bomb.bz2"
    path.write_bytes(bombs.BZ2[what]())
    refuses(read("bal", path))


@pytest.mark.parametrize("what", list(bombs.TRANSFORMS))
def test_transforms(read: Read, tmp_path: Path, what: str) -> None:
    bombs.make_pipe(tmp_path / "pipe")
    path = tmp_path / "transforms.json"
    path.write_bytes(bombs.TRANSFORMS[what])
    refuses(read("transforms", path))


@pytest.mark.parametrize("what", list(bombs.DATABASES))
def test_databases(read: Read, tmp_path: Path, what: str) -> None:
    path = tmp_path / "database.db"
    bombs.DATABASES[what](path)
    refuses(read("database", path))


@pytest.mark.parametrize("what", list(bombs.MODELS))
def test_models(read: Read, tmp_path: Path, what: str) -> None:
    bombs.MODELS[what](tmp_path / "model")
    refuses(read("colmap", tmp_path / "model"))


@pytest.mark.parametrize("what", [what for what in bombs.PACKED if IS_WHOLE or what not in SLOW])
def test_packed_files(read: Read, tmp_path: Path, what: str) -> None:
    """Sizes that a file says are held against its bytes before anything is unpacked."""
    reader, name, write = bombs.PACKED[what]
    (tmp_path / name).parent.mkdir(exist_ok=True)
    write(tmp_path / name)
    assert (tmp_path / name).stat().st_size < 3 << 20
    refuses(read(reader, tmp_path / name, most_mib=64 if reader in ("grid", "hash") else 400))


FILES = {
    "calibration": "a.yaml",
    "pfm": "a.pfm",
    "png16": "a.png",
    "header": "a.jpg",
    "rgb": "a.jpg",
    "copy": "a.jpg",
    "bal": "a.txt",
    "g2o": "a.g2o",
    "colmap": "cameras.bin",
    "database": "a.db",
    "ply": "a.ply",
    "transforms": "transforms.json",
    "truth": "a.camera",
    "stereo": "depth.pfm",
    "frame size": "a.mp4",
    "frames": "a.mp4",
    "pairs": "a.mp4",
    "folders": "left",
}


@pytest.mark.parametrize("what", list(bombs.NO_FILES))
def test_what_is_no_file(read: Read, tmp_path: Path, what: str) -> None:
    """No reader waits for a pipe, or reads a device to its end."""
    said = {}
    for reader, name in FILES.items():
        path = tmp_path / reader / name
        path.parent.mkdir()
        bombs.NO_FILES[what](path)
        said[reader] = read(reader, path)
    wrong = {reader: answer for reader, answer in said.items() if not answer.startswith("refused: ")}
    assert not wrong
