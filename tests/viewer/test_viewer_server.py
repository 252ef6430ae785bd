"""Where the viewer listens, and whom it answers."""

import functools
import http.client
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from viewer_scenes import OPEN, free_port, three_cameras

from epipole.cli.main import main
from epipole.errors import ConfigError
from epipole.io import write_colmap_model
from epipole.report.space_model import scene_of_model
from epipole.viewer import ViewerHandle, ports, view_scene
from epipole.viewer.allowed import is_allowed
from epipole.viewer.page_server import PageServer, Served, fixed


def view(**options: object) -> ViewerHandle:
    return view_scene(scene_of_model(three_cameras(), title="three", unit=""), block=False, **options)


@contextmanager
def shown(**options: object) -> Iterator[ViewerHandle]:
    handle = view(**options)
    try:
        yield handle
    finally:
        handle.stop()


@contextmanager
def taken(port: int = 0) -> Iterator[int]:
    with socket.socket() as other:
        other.bind(("127.0.0.1", port))
        other.listen()
        yield int(other.getsockname()[1])


def status_of_page(port: int, host: str, address: str = "/", **headers: str) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", address, headers={"Host": host, **headers})
    with connection.getresponse() as answer:
        return answer.status


@pytest.fixture(scope="module")
def page_port() -> Iterator[int]:
    with shown(port=free_port()) as handle:
        yield int(handle.url.rsplit(":", 1)[1])


def test_a_name_that_was_made_to_point_here_is_refused(page_port):
    port = page_port
    assert status_of_page(port, f"rebound.example:{port}") == 403
    assert status_of_page(port, "localhost:9000") == 200  # through a tunnel
    assert status_of_page(port, f"[::1]:{port}") == 200
    name = f"rebound.example:{port}"
    assert not is_allowed([name], [f"http://{name}"], is_local=True)


def test_a_page_answers_its_own_addresses_and_its_own_scripts_alone(page_port):
    own = f"127.0.0.1:{page_port}"
    assert status_of_page(page_port, own, "/data/points-0") == 200
    assert status_of_page(page_port, own, "/data/points-0", Origin=f"http://{own}") == 200
    for origin in ("http://evil.example", "null", f"http://127.0.0.1:{page_port + 1}"):
        assert status_of_page(page_port, own, "/data/points-0", Origin=origin) == 403
    for address in ("/data/../../etc/passwd", "/etc/passwd", "/picture/0", "/data/none", "/%2e%2e/a", "//a"):
        assert status_of_page(page_port, own, address) == 404


def test_headers_that_come_twice_or_not_at_all():
    assert not is_allowed([], [], is_local=False)
    assert not is_allowed(["localhost", "b"], [], is_local=True)
    assert not is_allowed(["localhost"], ["http://localhost", "http://b"], is_local=True)
    assert is_allowed(["LOCALHOST:1"], ["http://localhost:1"], is_local=True)


def test_other_machines_may_be_let_in_by_any_name_but_not_other_pages():
    with shown(port=free_port(), host="0.0.0.0") as handle:
        port = int(handle.url.rsplit(":", 1)[1])
        assert handle.url.startswith("http://127.0.0.1:")
        assert status_of_page(port, f"workstation.lab:{port}") == 200
        assert status_of_page(port, f"workstation.lab:{port}", Origin="http://evil.example") == 403


def test_a_port_that_was_asked_for_is_the_port_or_an_error():
    with taken() as port, pytest.raises(ConfigError, match=f"^port {port} is in use$"):
        view(port=port)


@pytest.mark.parametrize("port", [80000, 0, -1])
def test_a_port_that_cannot_be(port):
    with pytest.raises(ConfigError, match=f"between 1 and 65535, got {port}"):
        view(port=port)


@pytest.mark.parametrize(
    ("host", "words"), [("no.such.host.invalid", "not known"), ("192.0.2.1", "not an address")]
)
def test_a_host_that_cannot_be(host, words):
    with pytest.raises(ConfigError, match=words):
        view(host=host)


def test_the_usual_port_may_be_stepped_over_and_that_is_said(monkeypatch):
    with taken() as port:
        monkeypatch.setattr(ports, "DEFAULT_PORT", port)
        with shown() as handle:
            assert handle.url != f"http://127.0.0.1:{port}"
            with OPEN(handle.url, timeout=10) as answer:
                assert answer.status == 200
            assert handle.note == f"port {port} is in use; using {handle.url.rsplit(':', 1)[1]}"
    with shown() as handle:
        assert handle.url == f"http://127.0.0.1:{port}" and handle.note == ""


def test_the_command_says_in_one_sentence_what_is_wrong_with_a_port(tmp_path, capsys):
    write_colmap_model(three_cameras(), tmp_path)
    given = ["view", str(tmp_path), "--port"]
    with taken() as port:
        for requested, words in ((80000, "between 1 and 65535, got 80000"), (port, f"port {port} is in use")):
            with pytest.raises(SystemExit) as ended:
                main([*given, str(requested)])
            out, err = capsys.readouterr()
            assert ended.value.code == 2 and err.count("\n") == 1 and not out
            assert err.startswith("epipole: ") and words in err
    # A background job ignores Ctrl-C.
    heeding = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    command = [sys.executable, "-m", "epipole", *given, str(free_port())]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=heeding) as running:
        stop = threading.Timer(60, running.kill)
        stop.start()
        assert running.stdout.readline().startswith("Viewer at http://127.0.0.1:")
        os.kill(running.pid, signal.SIGINT)
        assert running.wait(30) == 130
        stop.cancel()


def reset(port: int) -> None:
    """Ask for the page, and close the connection before the answer, as a browser does whose tab is closed."""
    with socket.create_connection(("127.0.0.1", port)) as asking:
        asking.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        asking.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


def test_a_closed_tab_is_no_error(capfd: pytest.CaptureFixture[str]) -> None:
    pages = {"": fixed("text/html", b"x" * 30_000_000), "faulty": Served("text/html", lambda _: 1 // 0)}
    pages_server = PageServer(pages, "127.0.0.1", free_port())
    try:
        for _ in range(5):
            reset(pages_server.port)
        assert status_of_page(pages_server.port, "127.0.0.1") == 200
        time.sleep(0.2)
        assert capfd.readouterr().err == ""
        with pytest.raises(http.client.HTTPException):  # other faults are still shown
            status_of_page(pages_server.port, "127.0.0.1", "/faulty")
        assert "ZeroDivisionError" in capfd.readouterr().err
    finally:
        pages_server.stop()
