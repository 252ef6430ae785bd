"""The live page of a job: states, tabs that come late, get stuck or close, and requests that are refused."""

import http.client
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from test_viewer_kinds import Opened
from viewer_scenes import HOSTILE, OPEN, free_port

from epipole.geometry import Rigid3
from epipole.report.space_scene import CameraLayer, FirstView, PointLayer, SpaceScene
from epipole.scene import Curve
from epipole.viewer import live_stream
from epipole.viewer.live import LivePage, LiveScene, opened_live
from epipole.viewer.live_stream import MOST_STREAMS, LiveStream, scene_bytes
from epipole.viewer.page_server import Request
from epipole.viewer.requested_views import MOST_SIDE_PX, RequestedViews, camera_of

SECONDS = 20


def scene(num_points: int, title: str = "job") -> SpaceScene:
    rng = np.random.default_rng(0)
    none = np.zeros((0, 2, 3))
    return SpaceScene(
        title,
        "",
        "m",
        (PointLayer("Points", rng.normal(size=(num_points, 3)), np.full((num_points, 3), 250, np.uint8)),),
        CameraLayer(
            "Keyframes",
            (HOSTILE,),
            Rigid3.identity(1),
            np.array([np.diag([50.0, 50, 1])]),
            np.array([[64, 48]]),
        ),
        (Curve("path", none, (9, 99, 200)), Curve("now", none, (240, 170, 40))),
        view=FirstView(np.array([0.0, 0, -6]), np.zeros(3), np.array([0.0, -1, 0])),
    )


@contextmanager
def live(port: int, **options: object) -> Iterator[LiveScene]:
    page = LivePage(job="run", image_caption="green", has_camera=True)
    with opened_live(page, scene(0, HOSTILE), "127.0.0.1", port) as opened:
        yield opened


class Reader:
    """A tab's event stream, without a browser."""

    def __init__(self, port: int) -> None:
        self.connection = http.client.HTTPConnection("127.0.0.1", port, timeout=SECONDS)
        self.connection.request("GET", "/live/events", headers={"Host": "localhost"})
        self.answer = self.connection.getresponse()

    def next(self) -> dict:
        """The next state; {} where the stream is closed."""
        while line := self.answer.readline():
            if line.startswith(b"data: "):
                return json.loads(line[6:])
        return {}

    def until(self, **values: object) -> dict:
        while (state := self.next()) and any(state.get(k) != v for k, v in values.items()):
            pass
        return state

    def close(self) -> None:
        self.answer.close()
        self.connection.close()


def status(port: int, address: str, host: str = "localhost", **headers: str) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=SECONDS)
    connection.request(
        "GET", address, headers={"Host": host} | {k.replace("_", "-"): v for k, v in headers.items()}
    )
    found = connection.getresponse().status
    connection.close()
    return found


def test_a_late_tab_gets_the_whole_state_and_parts_are_made_once_when_asked_for() -> None:
    port, made = free_port(), []
    with live(port) as page:
        assert not page.is_watched and status(port, "/live/image") == 404
        page.publish({"words": "a"}, image=lambda: made.append(1) or b"jpeg")
        page.publish({"state": "b"})
        reader, other = Reader(port), Reader(port)
        for one in (reader, other):
            state = one.until(words="a", state="b")
            assert state["parts"] == {"image": 1}
        assert page.is_watched and not made
        for _ in range(2):
            assert OPEN(f"http://127.0.0.1:{port}/live/image", timeout=SECONDS).read() == b"jpeg"
        assert made == [1]
        page.publish({"words": "c"})
        assert reader.until(words="c")["state"] == "b" and other.until(words="c")
        other.close()
        assert status(port, "/live/final") == 200 and status(port, "/live/final") == 200
    assert reader.until(none=1) == {}  # the stream ends with the server
    with pytest.raises(OSError):
        OPEN(f"http://127.0.0.1:{port}/", timeout=2)


def test_the_end_is_announced_and_waits_for_tabs_but_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    port, start = free_port(), 0.0
    with live(port):
        start = time.monotonic()
    assert time.monotonic() - start < 2.0 < live_stream.END_S  # nobody watched
    monkeypatch.setattr(live_stream, "END_S", 0.5)
    with pytest.raises(ZeroDivisionError), live(port) as page:
        reader = Reader(port)
        reader.next()
        start = time.monotonic()
        _ = 1 // 0
    assert 0.5 <= time.monotonic() - start < 3.5
    assert "stopped with an error" in reader.until(none=1, **{}).get("ended", "") or page


def test_the_oldest_stream_makes_room_for_a_new_one() -> None:
    port = free_port()
    with live(port) as page:
        readers = []
        for _ in range(
            MOST_STREAMS + 1
        ):  # one by one: each connection has a thread of the server, whose order is open
            readers.append(Reader(port))
            assert readers[-1].next()["state"] == "Starting"
        assert readers[0].until(none=1) == {}
        page.publish({"words": "new"})
        assert all(reader.until(words="new") for reader in readers[1:])
        for _ in readers:
            status(port, "/live/final")


def test_a_tab_that_is_stuck_or_closed_delays_nobody(capfd: pytest.CaptureFixture[str]) -> None:
    port = free_port()
    with live(port) as page:
        stuck = socket.create_connection(("127.0.0.1", port))
        stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stuck.sendall(b"GET /live/events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        closed, reader = Reader(port), Reader(port)
        closed.next()
        closed.close()
        start = time.monotonic()
        for k in range(300):
            page.publish({"words": "x" * 50_000, "number": k})
        assert time.monotonic() - start < 2.0
        assert reader.until(number=299)
        for _ in range(3):
            status(port, "/live/final")
        stuck.close()
    assert "Traceback" not in capfd.readouterr().err


def test_other_pages_and_other_names_are_refused() -> None:
    port = free_port()
    with live(port) as page:
        page.publish({}, image=lambda: b"jpeg")
        for address in ("/live/events", "/live/scene", "/live/image", "/live/final", "/"):
            assert status(port, address, Origin="http://evil.example") == 403
            assert status(port, address, host="rebound.example") == 403
            assert status(port, address, Sec_Fetch_Site="cross-site", Sec_Fetch_Dest="image") == 403
        assert status(port, "/", Sec_Fetch_Site="cross-site", Sec_Fetch_Dest="document") == 200  # a link
        for address in ("/live/../etc/passwd", "/live", "/live/none", "/live/events/"):
            assert status(port, address) == 404
        assert not page.is_watched


def test_a_scene_is_one_message_of_numbers_and_blocks() -> None:
    found = scene_bytes(scene(5), np.zeros(3))
    size = int.from_bytes(found[:4], "little")
    numbers = json.loads(found[4 : 4 + size])
    assert sum(numbers["lengths"]) == len(found) - 4 - size
    at = 4 + size + sum(numbers["lengths"][: numbers["blocks"].index("points-0")])
    rows = np.frombuffer(found[at : at + 80], "<f4").reshape(5, 4)[:, :3]
    wanted = scene(5).points[0].xyz_in_world.astype(np.float32)
    assert sorted(rows.tolist()) == sorted(wanted.tolist()) and numbers["points"][0]["count"] == 5


def test_the_camera_of_a_viewpoint() -> None:
    values = np.array([0.0, 0, -5, 0, 0, 2, 0, 3, 0, np.tan(np.deg2rad(30.0)), 1.5])
    camera, cam_from_world = camera_of(values, MOST_SIDE_PX)
    assert (camera.width, camera.height) == (480, MOST_SIDE_PX)
    np.testing.assert_allclose(
        camera.project(cam_from_world.apply(np.zeros((1, 3)))), [[239.5, 159.5]], atol=1e-9
    )
    top, bottom = camera.unproject(np.array([[239.5, -0.5], [239.5, 319.5]]))
    assert np.rad2deg(
        np.arccos(top @ bottom / np.linalg.norm(top) / np.linalg.norm(bottom))
    ) == pytest.approx(60.0)
    assert cam_from_world.apply(np.array([[1.0, 2.0, 0.0]])).tolist() == [[1.0, 2.0, 5.0]]
    wide = values.copy()
    wide[10] = 1e9
    assert camera_of(wide, 100)[0].width == 400
    for k, wrong in [(0, np.nan), (5, 0.0), (7, 0.0), (9, 0.0), (9, -1.0)]:
        bad = values.copy()
        bad[k] = wrong
        assert camera_of(bad, 100) is None
    assert camera_of(values[:10], 100) is None


def test_views_are_rendered_by_the_job_and_a_few_may_wait() -> None:
    requested, query = RequestedViews(), "0,0,-5,0,0,1,0,1,0,0.5,1"
    none = http.client.HTTPMessage()
    assert requested.answer(Request(none, "")) is None and requested.answer(Request(none, "a,b")) is None
    answers: list[bytes | None] = []
    tabs = [
        threading.Thread(target=lambda: answers.append(requested.answer(Request(none, query))))
        for _ in range(2)
    ]
    for tab in tabs:
        tab.start()
    count, stop = 0, time.monotonic() + SECONDS
    while count < 2 and time.monotonic() < stop:
        count += requested.render_next(
            lambda camera, _: np.ones((camera.height, camera.width, 3), np.float32)
        )
        time.sleep(0.001)
    for tab in tabs:
        tab.join(SECONDS)
    assert [bytes(answer or b"")[:2] for answer in answers] == [b"\xff\xd8"] * 2
    assert not requested.render_next(lambda *_: np.zeros((1, 1, 3), np.float32))


def test_a_page_follows_the_job_to_its_end(browser: object) -> None:
    port = free_port()
    with live(port) as page:
        tab = Opened(browser, f"http://127.0.0.1:{port}/", 240, 180)
        tab.page.wait_for_selector("html[data-live=running]")
        assert tab.page.inner_text("h1") == HOSTILE
        edges = np.arange(48.0) / 24 - 1
        page.publish(
            {
                "state": HOSTILE,
                "words": "one",
                "fraction": 0.5,
                "camera": edges.tolist(),
                "position": [0, 0, 1],
            },
            lambda: scene(2000),
        )
        tab.page.wait_for_selector("progress:not([hidden])")
        assert tab.page.inner_text("#live-state") == HOSTILE and tab.page.inner_text("#live-words") == "one"
        wait_for(tab, "space.then(s => s.data.points[0].count === 2000 && s.view.eye().focus[2] === 1)")
        late = Opened(browser, f"http://127.0.0.1:{port}/", 240, 180)
        wait_for(late, "space.then(s => s.data.points[0].count === 2000)")
        late.page.click("#follow-camera")
        page.publish({"position": [0, 0, 2]}, lambda: scene(3000))
        wait_for(tab, "space.then(s => s.data.points[0].count === 3000 && s.view.eye().focus[2] === 2)")
        wait_for(late, "space.then(s => s.data.points[0].count === 3000)")
        assert late.page.evaluate("space.then(s => s.view.eye().focus[2])") == 1
        page.publish({}, lambda: scene(1000))

        # The end waits for the tabs, which live in this thread.
        closing = threading.Event()

        def descriptor() -> None:
            for one in (tab, late):
                one.page.wait_for_selector("html[data-live=final]")
            closing.set()

        page.meanwhile = lambda: None if closing.is_set() else descriptor()
    for one in (tab, late):
        assert one.page.inner_text("#live-state") == "The run has ended. This is the final state."
        assert one.page.evaluate("space.then(s => s.data.points[0].count)") == 1000
        assert np.ptp(one.rendered()) > 100
        one.close()


def wait_for(tab: Opened, expression: str) -> None:
    stop = time.monotonic() + SECONDS
    while not tab.page.evaluate(expression):
        assert time.monotonic() < stop, (expression, tab.problems)
        tab.page.wait_for_timeout(20)


def test_a_page_whose_job_was_killed_says_so(browser: object, monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    monkeypatch.setattr(live_stream, "END_S", 0.0)
    monkeypatch.setattr(LiveStream, "end", lambda *_: None)  # as if the process was killed
    with live(port):
        tab = Opened(browser, f"http://127.0.0.1:{port}/", 240, 180)
        tab.page.wait_for_selector("html[data-live=running]")
    tab.page.wait_for_selector("html[data-live=lost]")
    assert "No connection to the job" in tab.page.inner_text(".lead")
    tab.page.close()
