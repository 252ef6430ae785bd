"""The lesson as files and from a server."""

import socket
import urllib.error
import urllib.request

import pytest

from epipole.errors import ConfigError, WorkspaceError
from epipole.lesson.pages import lesson_pages
from epipole.lesson.run import export_lesson, open_lesson


@pytest.fixture
def address():
    handle = open_lesson()
    yield handle.url
    handle.stop()


def text_of(address, **headers):
    with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=10) as answer:
        return answer.read().decode()


def test_pages_are_answered_in_the_readers_language(address):
    pages = lesson_pages()
    assert text_of(address + "/") == pages["index.html"]
    assert text_of(address + "/", **{"Accept-Language": "zh-CN,zh;q=0.9"}) == pages["index.zh.html"]
    assert text_of(address + "/01_disparity.zh.html?x=1") == pages["01_disparity.zh.html"]


@pytest.mark.parametrize("path", ["/../pages.py", "/etc/passwd", "/%2e%2e/pages.py", "/none"])
def test_nothing_but_pages_is_answered(address, path):
    with pytest.raises(urllib.error.HTTPError, match="404"):
        text_of(address + path)


def test_files_are_written_whole(tmp_path):
    done = export_lesson(tmp_path / "new" / "folder")
    assert sorted(done.pages) == sorted(path.name for path in done.folder.iterdir())
    assert done.num_bytes == sum(path.stat().st_size for path in done.folder.iterdir())
    (tmp_path / "file").write_text("")
    with pytest.raises(WorkspaceError):
        export_lesson(tmp_path / "file")


def test_wrong_ports_are_told():
    with pytest.raises(ConfigError, match="between 1 and 65535"):
        open_lesson(port=0)
    with pytest.raises(ConfigError, match="not an address of this machine"):
        open_lesson("192.0.2.1", 8099)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(ConfigError, match="in use"):
            open_lesson(port=taken.getsockname()[1])
