"""Recordings of ROS are written by rosbags and read back: topics, cameras, images, pairs by stamps, IMU, damage."""

import builtins
import shutil

import numpy as np
import pytest

from bag_writing import KINDS, Recorded, jpeg, png
from epipole.errors import ConfigError, FileFormatError, MissingDependencyError
from epipole.io.bags._pairing import grouped, paired
from epipole.io.bags.recording import bag_frames, is_bag, read_bag, read_bag_imu, read_bag_topics
from epipole.io.bags.rig_recording import bag_rig_frames, read_bag_rig
from epipole.io.calibration.camera_topics import camera_topics
from epipole.io.sequences.imu_logs import read_imu

SECOND, STEP = 10**9, 10**8
BEGIN = 1_500_000_000 * SECOND
SIZE = (32, 24)
K = np.array([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]])
D = (0.1, -0.02, 0.001, 0.002, 0.0)


def gray(n: int) -> np.ndarray:
    return np.random.default_rng(n).integers(0, 256, SIZE[::-1], np.uint8)


def smooth(n: int) -> np.ndarray:
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    return (4 * x + 2 * y + n).astype(np.uint8)


@pytest.fixture(params=KINDS)
def recorded(request):
    return Recorded(request.param)


def test_one_camera(recorded, tmp_path):
    for n in range(4):
        recorded.image("/cam/image_raw", BEGIN + n * STEP, gray(n), "mono8", BEGIN + n * STEP - 7_000_000)
    recorded.camera_info("/cam/camera_info", BEGIN, SIZE, K, D)
    path = recorded.write(tmp_path)
    assert is_bag(path) and not is_bag(tmp_path / "none.bag") and not is_bag(tmp_path)
    bag = read_bag(path)
    assert (bag.sensor, bag.topics, bag.num_frames, bag.size) == ("mono", ("/cam/image_raw",), 4, SIZE)
    assert bag.camera.model.name == "OPENCV" and np.allclose(bag.camera.params, [30, 30, 15.5, 11.5, *D[:4]])
    frames = list(bag_frames(bag))
    times = [frame.timestamp_s for frame in frames]
    assert np.allclose(times, BEGIN / SECOND - 0.007 + 0.1 * np.arange(4), atol=1e-6)  # of headers
    for n, frame in enumerate(frames):
        assert np.array_equal(frame.gray(), gray(n))
    topics = {t.name: (t.kind, t.num_messages) for t in read_bag_topics(path)}
    assert topics == {"/cam/image_raw": ("image", 4), "/cam/camera_info": ("camera", 1)}


def test_a_raw_pair_is_told_by_its_projections(recorded, tmp_path):
    """R and P of a pair whose right camera is turned, as ROS defines them."""
    from epipole.geometry import Rotation3

    R1, R2 = (Rotation3.exp(np.array(w)).matrix for w in ([0.01, 0.02, 0.0], [0.01, -0.03, 0.005]))
    P = np.column_stack([K, np.zeros(3)])
    for name, R, corner in (("left", R1, 0.0), ("right", R2, -30.0 * 0.12)):
        P2 = P.copy()
        P2[0, 3] = corner
        recorded.camera_info(f"/{name}/camera_info", BEGIN, SIZE, K, D, R, P2)
        recorded.image(f"/{name}/image_raw", BEGIN, gray(1), "mono8")
    bag = read_bag(recorded.write(tmp_path))
    assert (bag.sensor, bag.topics) == ("stereo", ("/left/image_raw", "/right/image_raw"))
    point = np.array([0.3, -0.2, 4.0])
    in_left_rectified = R1 @ point
    expected = R2.T @ (in_left_rectified - [0.12, 0, 0])
    assert np.allclose(bag.rig.right_from_left.apply(point), expected)


def test_rectified_pictures_are_preferred_and_their_camera_is_that_of_p(recorded, tmp_path):
    flat = np.array([[25.0, 0, 14.0], [0, 25.0, 10.0], [0, 0, 1]])
    for name, corner in (("left", 0.0), ("right", -25.0 * 0.2)):
        P = np.column_stack([flat, [corner, 0, 0]])
        recorded.camera_info(f"/s/{name}/camera_info", BEGIN, SIZE, K, D, P=P)
        for kind in ("image_raw", "image_rect", "image_rect_color"):
            channels = "bgr8" if kind.endswith("color") else "mono8"
            image = np.repeat(gray(1)[..., None], 3, 2) if channels == "bgr8" else gray(1)
            recorded.image(f"/s/{name}/{kind}", BEGIN, image, channels)
    path = recorded.write(tmp_path)
    bag = read_bag(path)
    assert bag.topics == ("/s/left/image_rect", "/s/right/image_rect")
    assert bag.camera.model.name == "PINHOLE" and np.allclose(bag.camera.params, [25, 25, 14, 10])
    assert bag.rig.baseline == pytest.approx(0.2) and np.allclose(bag.rig.right_from_left.rotation, np.eye(3))
    raw = read_bag(path, topics=("/s/left/image_raw", "s/right/image_raw"))
    assert raw.topics == ("/s/left/image_raw", "/s/right/image_raw") and raw.camera.params[0] == 30
    assert read_bag(path, "mono").topics == ("/s/left/image_rect",)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "png", "compressedDepth"])
def test_depth_in_meters(recorded, tmp_path, encoding):
    millimeters = np.random.default_rng(1).integers(400, 5000, SIZE[::-1]).astype(np.uint16)
    millimeters[0, :3] = 0
    meters = millimeters.astype(np.float32) / 1000
    recorded.image("/camera/rgb/image_color", BEGIN, np.repeat(gray(1)[..., None], 3, 2), "rgb8")
    topic = "/camera/depth_registered/image_raw"
    if encoding == "16UC1":
        recorded.image(topic, BEGIN + 5_000_000, millimeters, encoding)
    elif encoding == "32FC1":
        recorded.image(topic, BEGIN, np.where(meters > 0, meters, np.nan).astype(np.float32), encoding)
    elif encoding == "png":
        recorded.compressed(f"{topic}/compressed", BEGIN, png(millimeters), "16UC1; png compressed depth")
    else:
        header = np.array([0], "<i4").tobytes() + np.array([0, 0], "<f4").tobytes()
        recorded.compressed(
            f"{topic}/compressedDepth", BEGIN, header + png(millimeters), "16UC1; compressedDepth png"
        )
    bag = read_bag(recorded.write(tmp_path))
    assert bag.sensor == "rgbd" and bag.camera is None and not bag.warnings
    (frame,) = bag_frames(bag)
    depth = frame.depth()
    assert depth.dtype == np.float32 and np.allclose(depth, meters, atol=1e-6) and (depth[0, :3] == 0).all()
    assert frame.right_gray is None and np.abs(frame.gray().astype(int) - gray(1)).max() <= 1


def test_inverse_depth_of_floats(tmp_path):
    """compressed_depth_image_transport: number = a / depth + b."""
    recorded = Recorded("mcap")
    meters = np.linspace(0.5, 8, SIZE[0] * SIZE[1], dtype=np.float32).reshape(SIZE[::-1])
    a, b = 1000.0, 3.0
    numbers = np.rint(a / meters + b).astype(np.uint16)
    header = np.array([0], "<i4").tobytes() + np.array([a, b], "<f4").tobytes()
    recorded.image("/c/image", BEGIN, gray(0), "mono8")
    recorded.compressed("/d/compressedDepth", BEGIN, header + png(numbers), "32FC1; compressedDepth png")
    (frame,) = bag_frames(read_bag(recorded.write(tmp_path)))
    assert np.allclose(frame.depth(), a / (numbers - b), rtol=1e-5)
    assert np.allclose(frame.depth(), meters, rtol=5e-3)


def test_encodings_and_compressed_pictures(recorded, tmp_path):
    wide = np.zeros((SIZE[1], SIZE[0] + 9), np.uint8)  # rows with room behind them
    wide[:, : SIZE[0]] = smooth(0)
    colors = np.random.default_rng(3).integers(0, 256, (*SIZE[::-1], 3), np.uint8)
    luma = np.rint(colors @ [0.114, 0.587, 0.299])
    recorded.image("/padded", BEGIN, wide, "mono8")
    recorded.rows[-1][3].width = SIZE[0]
    recorded.image("/bgr", BEGIN, colors, "bgr8")
    recorded.image("/rgb", BEGIN, colors[:, :, ::-1], "rgb8")
    recorded.image("/deep", BEGIN, smooth(0).astype(np.uint16) << 8, "mono16")
    recorded.image("/bayer", BEGIN, np.full(SIZE[::-1], 77, np.uint8), "bayer_rggb8")
    recorded.compressed("/jpeg", BEGIN, jpeg(smooth(0)), "jpeg")
    recorded.compressed("/png", BEGIN, png(smooth(0)), "png")
    path = recorded.write(tmp_path)

    def first(topic):
        return next(bag_frames(read_bag(path, topics=(topic,)))).gray()

    for topic in ("/padded", "/deep", "/png"):
        assert np.array_equal(first(topic), smooth(0)), topic
    for topic in ("/bgr", "/rgb"):
        assert np.abs(first(topic) - luma).max() <= 1
    assert np.abs(first("/jpeg").astype(int) - smooth(0)).mean() < 3
    assert (first("/bayer") == 77).all()


def test_topics_that_could_be_meant_are_listed(recorded, tmp_path):
    for name in ("/front/image_raw", "/rear/image_raw"):
        recorded.image(name, BEGIN, gray(1), "mono8")
    recorded.imu("/imu", BEGIN, (0, 0, 0), (0, 0, 9.8))
    path = recorded.write(tmp_path)
    with pytest.raises(ConfigError, match=r"several topics.*/front/image_raw or /rear/image_raw.*1 of Imu"):
        read_bag(path)
    assert read_bag(path, topics=("/rear/image_raw",)).topics == ("/rear/image_raw",)
    assert read_bag(path, topics=("/rear/image_raw", "/front/image_raw")).sensor == "stereo"
    for requested, sensor, words in (
        (("/imu",), "auto", "/imu has no images"),
        (("/none",), "auto", "/none has no images"),
        (("/rear/image_raw",) * 2, "auto", "one or two different names"),
        (("/rear/image_raw",), "stereo", "are mono, not stereo"),
        ((), "rgbd", "no topics for rgbd"),
        ((), "stereo", "no topics for stereo"),
    ):
        with pytest.raises(ConfigError, match=words):
            read_bag(path, sensor, requested)


def test_endless_names_of_topics_are_cut_off_in_errors(recorded, tmp_path):
    for name in ("/a/" + "x" * 9000, "/b/" + "x" * 9000):
        recorded.image(name, BEGIN, gray(1), "mono8")
    with pytest.raises(ConfigError, match="several topics") as caught:
        read_bag(recorded.write(tmp_path))
    assert len(str(caught.value)) < 9000


def test_depth_of_another_place_and_wrong_sizes_are_told(recorded, tmp_path):
    recorded.image("/rgb/image", BEGIN, gray(1), "mono8")
    recorded.image("/depth/image", BEGIN, np.ones(SIZE[::-1], np.float32), "32FC1")
    recorded.camera_info("/rgb/camera_info", BEGIN, (64, 48), K, frame_id="color")
    recorded.camera_info("/depth/camera_info", BEGIN, SIZE, K, frame_id="depth")
    bag = read_bag(recorded.write(tmp_path))
    assert bag.camera is None and bag.depth_camera is not None
    assert any("64 x 48 pixels, but its images have 32 x 24" in warning for warning in bag.warnings)


def test_unregistered_depth_without_its_camera_info_is_told(recorded, tmp_path):
    recorded.image("/color/image_raw", BEGIN, gray(1), "mono8", frame_id="camera_color_optical_frame")
    depth = np.full(SIZE[::-1], 1000, np.uint16)
    recorded.image("/depth/image_rect_raw", BEGIN, depth, "16UC1", frame_id="camera_depth_optical_frame")
    recorded.camera_info("/color/camera_info", BEGIN, SIZE, K, frame_id="camera_color_optical_frame")
    (warning,) = read_bag(recorded.write(tmp_path)).warnings
    assert "its frame is camera_depth_optical_frame" in warning


def test_unregistered_depth_is_told(recorded, tmp_path):
    recorded.image("/rgb/image", BEGIN, gray(1), "mono8")
    recorded.image("/depth/image", BEGIN, np.ones(SIZE[::-1], np.float32), "32FC1")
    for name in ("rgb", "depth"):
        recorded.camera_info(f"/{name}/camera_info", BEGIN, SIZE, K, frame_id=name)
    (warning,) = read_bag(recorded.write(tmp_path)).warnings
    assert "not registered" in warning and "depth" in warning


def test_stamps_make_pairs():
    left = [(0, 0.1 * n, f"l{n}") for n in range(6)]
    right = [(1, 0.1 * n + 0.003, f"r{n}") for n in range(6) if n != 2]
    found = list(paired(sorted(left + right, key=lambda row: row[1]), 0.005))
    assert [(a, b) for _, a, b in found] == [(f"l{n}", f"r{n}") for n in range(6) if n != 2]
    assert list(paired(left + right, 0.005)) == found  # one topic after the other
    assert list(paired(left, 0.005)) == []


def test_the_nearest_is_taken_of_several():
    """Depth three times as often as images, and a tolerance that reaches two of them."""
    left = [(0, 0.1 * n, n) for n in range(5)]
    right = [(1, 0.1 * n + d, n + d) for n in range(5) for d in (-0.015, 0.004, 0.02)]
    found = list(paired(sorted(left + right, key=lambda row: row[1]), 0.02))
    assert [(a, round(b - a, 3)) for _, a, b in found] == [(n, 0.004) for n in range(5)]


def test_a_topic_that_falls_silent_does_not_fill_the_memory():
    def rows():
        yield 1, 0.0, 0
        for n in range(5000):
            yield 0, 1.0 + n, n
        yield 1, 5000.0, 1

    assert list(paired(rows(), 0.5)) == [(5000.0, 4999, 1)]


def test_what_an_imu_measured(recorded, tmp_path):
    rotation, gradient = np.arange(12.0).reshape(4, 3), 10 + np.arange(12.0).reshape(4, 3)
    for n in range(4):
        recorded.imu("/imu", BEGIN + n * STEP, rotation[n], gradient[n])
    path = recorded.write(tmp_path)
    found = read_bag_imu(path)
    assert np.array_equal(found.gyro_rad_s, rotation)
    assert np.array_equal(found.accel_m_s2, gradient) and len(found) == 4
    assert np.allclose(found.timestamp_s, BEGIN / SECOND + 0.1 * np.arange(4), atol=1e-6)
    with pytest.raises(ConfigError, match="no IMU topic"):
        read_bag_imu(path, "/other")
    with pytest.raises(ConfigError, match="no topics for mono"):
        read_bag(path)
    recorded.imu("/second", BEGIN, rotation[0], gradient[0])
    again = recorded.write(tmp_path, "two")
    with pytest.raises(ConfigError, match="several IMUs"):
        read_bag_imu(again)
    assert len(read_bag_imu(again, "/second")) == 1


def test_an_imu_with_two_topics(recorded, tmp_path):
    """As RealSense's cameras publish it: 200 and 63 Hz, the other half zero."""
    nothing = np.zeros(3)
    for n in range(40):
        recorded.imu("/gyro", BEGIN + n * STEP // 20, np.array([0.1 * n, 0, 0]), nothing)
    for n in range(13):
        recorded.imu("/accel", BEGIN + n * STEP // 6, nothing, np.array([0.3 * n, 9.8, 0]))
    path = recorded.write(tmp_path)
    found = read_bag_imu(path, "/gyro,/accel")
    times = 0.005 * np.arange(40)
    np.testing.assert_allclose(found.timestamp_s - BEGIN / SECOND, times, atol=1e-6)
    np.testing.assert_allclose(found.gyro_rad_s[:, 0], 0.1 * np.arange(40))
    np.testing.assert_allclose(found.accel_m_s2[:, 0], 0.3 * times / (0.1 / 6), atol=1e-5)
    assert np.array_equal(read_imu(path, topic="/gyro,/accel")[0].accel_m_s2, found.accel_m_s2)
    with pytest.raises(FileFormatError, match="gravity"):
        read_bag_imu(path, "/accel, /gyro")  # exchanged: accelerations are zero
    for n in (60, 61, 62):  # a pause from 0.2 to 1.0 s
        recorded.imu("/accel", BEGIN + n * STEP // 6, nothing, np.array([0.3 * n, 9.8, 0]))
    for n in range(40, 207):
        recorded.imu("/gyro", BEGIN + n * STEP // 20, np.array([1.0, 0, 0]), nothing)
    paused = read_bag_imu(recorded.write(tmp_path, "paused"), "/gyro,/accel").timestamp_s - BEGIN / SECOND
    assert not ((paused > 0.201) & (paused < 0.999)).any() and paused[-1] > 1.02
    for topic in ("/gyro,/other", "/gyro,/accel,/gyro"):
        with pytest.raises(ConfigError, match=f"no IMU topic found for '{topic}'"):
            read_bag_imu(path, topic)
    table = tmp_path / "imu.txt"
    table.write_text("0.1 0 0 0 0 0 9.8\n0.2 0 0 0 0 0 9.8\n")
    with pytest.raises(ConfigError, match="not a ROS recording"):
        read_imu(table, topic="/imu")
    recorded.imu("/late", BEGIN + 100 * STEP, nothing, nothing)
    recorded.imu("/late", BEGIN + 101 * STEP, nothing, nothing)
    with pytest.raises(FileFormatError, match="do not overlap"):
        read_bag_imu(recorded.write(tmp_path, "late"), "/gyro,/late")


def test_samples_of_an_imu_out_of_order_are_sorted_and_told(recorded, tmp_path):
    stamps = [0, 1, 2, 5, 4, 3, 6, 6, *range(7, 20)]
    for n, k in enumerate(stamps):
        stamp = BEGIN + k * STEP // 20
        recorded.imu("/imu", BEGIN + n * STEP, np.array([0.01 * k, 0, 0]), np.array([0, 0, 9.81]), stamp)
    found = read_bag_imu(recorded.write(tmp_path))
    assert np.allclose(found.gyro_rad_s[:, 0], 0.01 * np.arange(20))
    earlier, repeated = found.notes
    assert "2 samples are earlier" in earlier and "1 samples repeat a time" in repeated


def test_an_empty_recording(recorded, tmp_path):
    with pytest.raises(FileFormatError, match=r"ride.*no messages"):
        read_bag(recorded.write(tmp_path))


def storage(path):
    return path if path.is_file() else next(f for f in path.iterdir() if f.suffix in (".db3", ".mcap"))


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_what_stands_before_a_cut_is_read(kind, tmp_path):
    recorded = Recorded(kind)
    rng = np.random.default_rng(0)
    for n in range(40):
        noise = rng.integers(0, 256, (200, 300), np.uint8)
        recorded.image("/cam/image_raw", BEGIN + n * STEP, noise, "mono8")
    path = recorded.write(tmp_path)
    whole = [frame.gray() for frame in bag_frames(read_bag(path))]
    data = storage(path).read_bytes()
    for fraction in (0.95, 0.6):
        storage(path).write_bytes(data[: int(fraction * len(data))])
        bag = read_bag(path)
        assert any("before the damage or truncation" in warning for warning in bag.warnings)
        found = [frame.gray() for frame in bag_frames(bag)]
        assert 5 < len(found) <= fraction * 40
        assert all(np.array_equal(a, b) for a, b in zip(found, whole))
    if kind == "mcap":  # a recording that was never closed has no metadata.yaml
        (path / "metadata.yaml").unlink()
        assert is_bag(path) and read_bag(path).num_frames == len(found)
    storage(path).write_bytes(data[:100])
    with pytest.raises(FileFormatError, match="ride"):
        read_bag(path)


def test_damage_in_the_middle_keeps_the_frames_before(tmp_path):
    recorded = Recorded("sqlite")
    for n in range(60):
        recorded.image("/cam/image_raw", BEGIN + n * STEP, np.full((100, 120), n, np.uint8), "mono8")
    path = recorded.write(tmp_path)
    data = bytearray(storage(path).read_bytes())
    page = 4096 * (len(data) // 8192)
    data[page : page + 4096 * 4] = b"\xff" * 4096 * 4
    storage(path).write_bytes(data)
    bag = read_bag(path)
    found = [frame.gray() for frame in bag_frames(bag)]
    assert 10 < len(found) < 60 and any(
        "malformed; only the part before" in warning for warning in bag.warnings
    )
    assert all((image == n).all() for n, image in enumerate(found))


def test_pictures_that_make_no_sense(recorded, tmp_path):
    recorded.image("/good/image", BEGIN, gray(1), "mono8")
    for n in range(3):
        recorded.image("/bad/image", BEGIN + n, gray(n), "mono8")
    recorded.rows[-2][3].height = 1000
    recorded.rows[-1][3].encoding = "purple"
    path = recorded.write(tmp_path)
    first, *rest = bag_frames(read_bag(path, topics=("/bad/image",)))
    assert np.array_equal(first.gray(), gray(0))
    for frame, words in zip(rest, ("do not match an image of 32 x 1000", "'purple' is not supported")):
        with pytest.raises(FileFormatError, match=words):
            frame.gray()


def test_cameras_that_make_no_sense(recorded, tmp_path):
    recorded.image("/a/image", BEGIN, gray(1), "mono8")
    recorded.camera_info("/a/camera_info", BEGIN, SIZE, K, D, model="rubber")
    recorded.image("/b/image", BEGIN, gray(1), "mono8")
    recorded.camera_info("/b/camera_info", BEGIN, SIZE, 0 * K)
    recorded.image("/c/image", BEGIN, gray(1), "mono8")
    recorded.camera_info("/c/camera_info", BEGIN, SIZE, K * np.nan)
    path = recorded.write(tmp_path)
    with pytest.raises(FileFormatError, match="unknown distortion_model rubber"):
        read_bag(path, topics=("/a/image",))
    assert read_bag(path, topics=("/b/image",)).camera is None
    with pytest.raises(FileFormatError, match="not finite"):
        read_bag(path, topics=("/c/image",))


def test_without_rosbags_the_line_to_install_it_is_told(recorded, tmp_path, monkeypatch):
    recorded.image("/a/image", BEGIN, gray(1), "mono8")
    path = recorded.write(tmp_path)
    imported = builtins.__import__

    def refuse(name, *rest, **more):
        if name.startswith("rosbags"):
            raise ImportError(name)
        return imported(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(MissingDependencyError, match=r"pip install 'epipole\[ros\]'"):
        read_bag(path)


def test_folders_and_files_that_are_no_recording(tmp_path):
    recorded = Recorded("sqlite")
    recorded.image("/a/image", BEGIN, gray(1), "mono8")
    path = recorded.write(tmp_path)
    shutil.copy(path / "ride.db3", tmp_path / "alone.db3")
    assert read_bag(tmp_path / "alone.db3").num_frames == 1
    (path / "metadata.yaml").write_text("nothing")
    (warning,) = read_bag(path).warnings
    assert "metadata" in warning
    for name, data in (("a.bag", b""), ("b.mcap", b"\x89MCAP0\r\n"), ("c.db3", b"text")):
        (tmp_path / name).write_bytes(data)
    for wrong in (tmp_path / "a.bag", tmp_path / "b.mcap", tmp_path / "c.db3"):
        with pytest.raises(FileFormatError, match=wrong.name):
            read_bag(wrong)


def test_messages_of_several_topics_are_grouped_by_their_times():
    """Three topics, of which one lags behind, one has jitter, and one misses an instant."""
    rows = [
        (0, 0.0, "a0"),
        (1, 0.003, "b0"),
        (0, 1.0, "a1"),
        (2, 0.001, "c0"),
        (1, 1.004, "b1"),
        (0, 2.0, "a2"),
    ]
    rows += [(2, 2.002, "c2"), (1, 1.999, "b2")]
    found = list(grouped(rows, 3, 0.005))
    assert found == [(0.0, ("a0", "b0", "c0")), (2.0, ("a2", "b2", "c2"))]
    assert list(grouped(rows[:2], 3, 0.005)) == []


def test_cameras_of_a_rig(recorded, tmp_path):
    """Images of one instant from each of three topics; the second instant lacks one, and sizes differ."""
    for n in range(4):
        for k, name in enumerate(("/cam2/image_raw", "/cam10/image_raw", "/cam1/image_raw")):
            if (n, k) != (1, 2):
                pixels = gray(10 * n + k)[: SIZE[1] - 2 * k]
                recorded.image(name, BEGIN + n * STEP + 2_000_000 * k, pixels, "mono8")
    path = recorded.write(tmp_path)
    bag = read_bag_rig(path, 3)
    assert bag.topics == ("/cam1/image_raw", "/cam2/image_raw", "/cam10/image_raw")
    assert bag.sizes == ((32, 20), (32, 24), (32, 22)) and bag.num_frames == 3
    frames = list(bag_rig_frames(bag))
    assert [round((frame.timestamp_s - BEGIN / SECOND) / 0.1, 1) for frame in frames] == [0.0, 2.0, 3.0]
    for frame, n in zip(frames, (0, 2, 3)):
        for read, k in zip(frame.grays, (2, 0, 1)):
            np.testing.assert_array_equal(read(), gray(10 * n + k)[: SIZE[1] - 2 * k])
    two = read_bag_rig(path, 2, ("cam10/image_raw", "/cam2/image_raw"))
    assert two.topics == ("/cam10/image_raw", "/cam2/image_raw") and two.num_frames == 4
    calibrated = read_bag_rig(path, 2, (), ("/cam10/image_raw", "cam1/image_raw"))
    assert calibrated.topics == ("/cam10/image_raw", "/cam1/image_raw") and not calibrated.warnings
    (warning,) = read_bag_rig(path, 3, (), ("/left", "/right", "/front")).warnings
    assert "assigned by name: /cam1/image_raw is camera 0" in warning
    with pytest.raises(ConfigError, match="the calibration has 2 cameras"):
        read_bag_rig(path, 2)
    with pytest.raises(ConfigError, match="the calibration has 2 cameras"):
        read_bag_rig(path, 2, ("/cam1/image_raw", "/cam1/image_raw"))
    with pytest.raises(ConfigError, match="/odom has no images"):
        read_bag_rig(path, 2, ("/odom", "/cam1/image_raw"))


@pytest.mark.parametrize(
    ("topics", "found"), [(("/b", "/a"), ("/b", "/a")), (("/b", None), ()), ((1, "/a"), ())]
)
def test_topics_of_a_calibration(tmp_path, topics, found):
    lines = []
    for k, topic in enumerate(topics):
        lines += [f"cam{k}:", "  camera_model: pinhole", "  intrinsics: [300, 300, 160, 120]"]
        lines += [] if topic is None else [f"  rostopic: {topic}"]
    (tmp_path / "camchain.yaml").write_text("\n".join(lines))
    assert camera_topics(tmp_path / "camchain.yaml") == found
