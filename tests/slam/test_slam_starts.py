"""The begin of one camera's map: doubted until frames after it agree, and refused where images cannot tell."""

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
from slam_rides import CAMERA, MONO, RGBD, ride, tracked

from epipole.cameras import Camera
from epipole.geometry import Rigid3, Rotation3
from epipole.io import read_trajectory
from epipole.metrics import absolute_error
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.frames import Frame, SlamCamera, TrackingState
from epipole.pipelines.slam.output.warnings import warnings
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.start import one_camera
from epipole.pipelines.slam.start.candidate_motions import Judged, judge, motions_of_plane, rival_of
from epipole.pipelines.slam.start.two_view import Confirmation
from whole import IS_WHOLE

pytestmark = pytest.mark.usefixtures("unchecked_module")

HOLOLENS = Path(__file__).parents[3] / "shared" / "data" / "slam" / "hololens"
LENS = Camera("PINHOLE", 540, 360, [495.5678, 495.4820, 270.0029, 169.6941])


def hololens(count: int) -> list[Frame]:
    rows = [line.split() for line in (HOLOLENS / "rgb.txt").read_text().splitlines() if line[0] != "#"]
    return [
        Frame(float(time), cv2.imread(str(HOLOLENS / name), cv2.IMREAD_GRAYSCALE))
        for time, name in rows[:count]
    ]


def turn_errors_deg(path) -> np.ndarray:
    """Of the steps of a path against the true one."""
    truth = read_trajectory(HOLOLENS / "groundtruth.txt")
    there = truth.world_from_body[np.abs(truth.timestamp_s[:, None] - path.timestamp_s).argmin(axis=0)]
    steps = [p[:-1].inverse() @ p[1:] for p in (path.world_from_body, there)]
    return np.degrees(Rotation3((steps[0].inverse() @ steps[1]).rotation).angle_rad())


needs_hololens = pytest.mark.skipif(not HOLOLENS.exists(), reason="HoloLens frames are not here")


@needs_hololens
def test_a_wall_of_little_texture_begins_no_wrong_map():
    slam, answers = tracked(hololens(30), SlamCamera(LENS))
    path = slam.trajectory()
    assert len(path) >= 20 and turn_errors_deg(path).max() < 1.5
    assert any("two motions explain them" in answer.reason for answer in answers)


@needs_hololens
@pytest.mark.parametrize("mapping", ["inline"] + IS_WHOLE * ["thread"])
def test_a_wrong_begin_is_given_up_when_later_frames_contradict_it(monkeypatch, mapping):
    """Without the comparison at the begin the wall begins a map that is wrong."""
    monkeypatch.setattr(one_camera, "best_start", lambda started, *_: started)
    slam, answers = Slam(SlamCamera(LENS), mapping=mapping), []
    for frame in hololens(30):
        answers.append(slam.track(frame))
        if slam.mapping_thread is not None:
            slam.mapping_thread.judges.submit(bool).result()
    slam.finish()
    first = next(n for n, a in enumerate(answers) if a.state is TrackingState.TRACKING)
    assert "not confirmed yet" in answers[first].reason
    assert "was discarded" in slam.start_warnings[0] and "contradict it" in slam.start_warnings[0]
    path, warned = slam.trajectory(), slam.start_warnings[1:]
    assert len(path) and (turn_errors_deg(path).max() < 1.5 or (mapping == "thread" and warned))
    assert answers[first].map_number != slam.maps[0].number


@needs_hololens
def test_a_verdict_that_comes_after_the_last_frame_is_reported(monkeypatch):
    monkeypatch.setattr(one_camera, "best_start", lambda started, *_: started)
    opened, confirm = threading.Event(), one_camera.confirm_start

    def later(*given):
        assert opened.wait(60.0)
        return confirm(*given)

    monkeypatch.setattr(one_camera, "confirm_start", later)
    slam = Slam(SlamCamera(LENS), mapping="thread")
    for frame in hololens(30):
        slam.track(frame)
        if (start := slam._unconfirmed) is not None and start._verdict is not None:
            break
    assert slam._unconfirmed is not None and not slam.start_warnings
    opened.set()
    slam.finish()
    (warning,) = slam.start_warnings
    assert "contradicted by" in warning or "could not be confirmed" in warning


@needs_hololens
def test_a_camera_that_is_lost_before_the_verdict_keeps_no_refuted_map(monkeypatch):
    monkeypatch.setattr(one_camera, "best_start", lambda started, *_: started)
    monkeypatch.setattr(one_camera, "confirm_start", lambda *_: Confirmation.REFUTED)
    monkeypatch.setattr(one_camera.OneCameraStart, "confirm", started_only)
    slam = Slam(SlamCamera(LENS), mapping="thread")
    frames = hololens(30)
    for frame in frames:
        slam.track(frame)
        if (start := slam._unconfirmed) is not None and start._verdict is not None:
            break
    assert slam._unconfirmed is not None
    number = slam.map.number
    blank = np.full_like(frame.gray, 128)
    slam.track(Frame(frame.timestamp_s + 0.1, blank))
    assert "contradict it" in slam.start_warnings[0] and slam.maps[0].number != number


def started_only(start, frame, number, cam_from_first):
    """The comparison begins, and no frame asks for its result."""
    start._track(frame)
    if start._verdict is None:
        start._verdict = start._beside(lambda: one_camera.confirm_start())
    return Confirmation.OPEN


def test_a_map_never_starts_with_an_image_with_a_problem():
    frames = ride().frames("mono")
    opened, choose = threading.Event(), one_camera.best_start

    def later(*given):
        assert opened.wait(60.0)
        return choose(*given)

    with pytest.MonkeyPatch.context() as patch, ThreadPoolExecutor(1) as judges:
        patch.setattr(one_camera, "best_start", later)
        patch.setattr(one_camera, "LONGEST_WAIT_S", 0.0)
        start, answers = one_camera.OneCameraStart(CAMERA, SlamConfig().odometry, judges), []
        for number, frame in enumerate(frames[:14]):
            if number == 12:
                opened.set()
                judges.submit(bool).result()
            answers.append(start.add(frame, number, "blurred" if number == 12 else ""))
    assert answers[12] == "blurred" and isinstance(answers[13], one_camera.Initialization)


def test_tracking_goes_on_while_motions_are_compared():
    opened, choose = threading.Event(), one_camera.best_start

    def later(*given):
        assert opened.wait(60.0)
        return choose(*given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(one_camera, "best_start", later)
        patch.setattr(one_camera, "LONGEST_WAIT_S", 0.0)
        slam, answers = Slam(MONO, mapping="thread"), []
        for number, frame in enumerate(ride().frames("mono")):
            answers.append(slam.track(frame))
            if number == 12:
                opened.set()
                slam.mapping_thread.judges.submit(bool).result()
    assert answers[12].state is TrackingState.STARTING and "being compared" in answers[12].reason
    assert all(answer.state is TrackingState.TRACKING for answer in answers[13:])
    slam.finish()
    path = slam.trajectory()
    assert len(path) == len(answers)
    assert absolute_error(path.world_from_body, ride().truth(), "similarity").position.rmse < 0.006


def test_a_slanted_plane_allows_two_motions_and_the_wrong_one_fits_less():
    """Frames between tell them apart, where the camera turns on its way."""
    rng = np.random.default_rng(3)
    xy = rng.uniform(-1, 1, (80, 2))
    points = np.column_stack([xy, 3.0 + 0.6 * xy[:, 0] + 0.3 * xy[:, 1]])
    positions = [
        Rigid3.exp(np.array([-0.06 * k, 0.01 * k, -0.09 * k, 0.002 * k * k, -0.004 * k, 0.003 * k]))
        for k in range(6)
    ]
    pixels = np.stack([CAMERA.project(position.apply(points)) for position in positions])
    pixels += rng.normal(0, 0.2, pixels.shape)
    motions = motions_of_plane(pixels[0], pixels[-1], CAMERA, 0)
    assert 1 <= len(motions) <= 2
    judged = [judge(motion, pixels, CAMERA) for motion in motions]
    best = min(judged, key=lambda one: one.loss)
    off = (best.cam_from_first @ positions[-1].inverse()).log()[3:]
    assert np.degrees(np.linalg.norm(off)) < 1.0
    twin = Judged(Rigid3.exp(np.array([1.0, 0.0, 0.0, 0.0, 0.1, 0.0])), 1.5 * best.loss, 2.0)
    assert rival_of(best, [best, twin]) is twin
    assert rival_of(best, [best, Judged(twin.cam_from_first, 3.0 * best.loss, 2.0)]) is None


def passing(width: float, height: float, kind: str, start: int, grow: float = 0.0) -> list[Frame]:
    """A camera at rest, and a thing with much texture that slides by, 4 pixels a frame."""
    still, rng = ride("rest", 1), np.random.default_rng(0)
    gray, depth = still.left[0].astype(float), still.depth[0]
    rows, columns = gray.shape
    thing = np.full((round(height * rows), round(width * columns)), 120.0)
    for size in (2, 5, 11):
        coarse = rng.normal(0, 40, (thing.shape[0] // size + 2, thing.shape[1] // size + 2))
        thing += cv2.resize(coarse, thing.shape[::-1], interpolation=cv2.INTER_CUBIC)
    out = []
    for n in range(40):
        gone = max(0, n - start)
        scale = 1.0 + grow * gone
        move = np.array(
            [
                [scale, 0, 0.05 * (columns - thing.shape[1]) + 4.0 * gone],
                [0, scale, 0.5 * (rows - thing.shape[0])],
            ]
        )
        mask = cv2.warpAffine(np.ones_like(thing), move, (columns, rows))
        rendered = gray * (1 - mask) + cv2.warpAffine(thing.clip(0, 255), move, (columns, rows)) * mask
        rendered = np.rint(rendered + rng.normal(0, 1.5, rendered.shape)).clip(0, 255).astype(np.uint8)
        deep = np.where(mask > 0.5, 1.0, depth).astype(np.float32) if kind == "rgbd" else None
        out.append(Frame(0.1 * n, rendered, None, deep))
    return out


@pytest.mark.parametrize(
    ("width", "height", "start", "grow"),
    [
        (0.3, 1.0, 0, 0.0),
        (0.55, 1.0, 5, 0.01),
        *(
            [(0.3, 1.0, 5, 0.0), (0.55, 1.0, 0, 0.0), (0.75, 1.0, 0, 0.0), (0.9, 0.45, 0, 0.0)]
            if IS_WHOLE
            else []
        ),
    ],
)
def test_one_camera_does_not_take_a_thing_that_passes_for_its_own_motion(width, height, start, grow):
    slam, answers = tracked(passing(width, height, "mono", start, grow), MONO)
    path = slam.trajectory()
    assert not slam.map.num_points and not path.world_from_body.translation.any()
    assert any("cannot distinguish an object that passes it" in answer.reason for answer in answers)


PASSING = [(0.3, 1.0), (0.55, 1.0), (0.75, 1.0), (0.9, 0.45)]


@pytest.mark.parametrize(("width", "height"), PASSING if IS_WHOLE else PASSING[2:3])
def test_with_depth_a_thing_that_passes_is_said_to(width, height):
    """Of most of the image it takes the camera along: then that is said."""
    slam, answers = tracked(passing(width, height, "rgbd", 5), RGBD)
    said = warnings(answers, slam.trajectory())
    assert any(
        "an object moves" in words or "image is static while the rest moves" in words for words in said
    )
    if width <= 0.3:  # it drifts 0.6 m with the thing
        assert np.linalg.norm(slam.trajectory().world_from_body.translation, axis=1).max() < 0.15


def test_a_camera_that_moves_is_not_said_to_rest():
    for kind, sensor in (("mono", MONO), ("rgbd", RGBD)):
        slam, answers = tracked(ride().frames(kind), sensor)
        assert slam.map.num_points and not any("static" in answer.reason for answer in answers)


def test_the_path_is_that_of_the_largest_map():
    """The camera loses itself early; what it sees then is another place, and it sees that for longer."""
    frames = ride().frames("rgbd")
    upside_down = [
        Frame(0.1 * n, f.gray[::-1].copy(), None, f.depth[::-1].copy()) for n, f in enumerate(frames)
    ]
    few = [Frame(f.timestamp_s - 0.6, f.gray, None, f.depth) for f in frames[:5]]
    slam, answers = tracked([*few, *upside_down], RGBD)
    slam.finish()
    counts = [len(slam.trajectory(number)) for number in range(len(slam.maps))]
    assert len(counts) == 2 and counts[0] > counts[1] == 5
    assert slam.maps[0].number == 1 and answers[-1].map_number == 1
    assert isinstance(slam, Slam)
