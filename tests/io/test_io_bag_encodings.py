"""Images of ROS with 16 bits, mosaics and rare encodings."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from epipole.errors import EpipoleError
from epipole.io.bags.recording import bag_frames, read_bag

pytest.importorskip("rosbags", reason="rosbags is not installed")
from bag_writing import Recorded

BEGIN, STEP = 1_700_000_000_000_000_000, 50_000_000
SIZE = (48, 32)


def smooth() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0, 1, SIZE[0]), np.linspace(0, 1, SIZE[1]))
    return 0.5 * (x + y)


def recorded(images: list[np.ndarray], encoding: str) -> Recorded:
    out = Recorded("mcap")
    for k, image in enumerate(images):
        out.image("/cam/image_raw", BEGIN + k * STEP, image, encoding)
    return out


def grays(made: Recorded, folder) -> list[np.ndarray]:
    return [frame.gray() for frame in bag_frames(read_bag(made.write(folder), "mono"))]


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_mono16_keeps_the_upper_bits_of_its_sensor_in_all_frames(tmp_path, bits):
    full = (1 << bits) - 1
    bright, dark = ((gain * full * smooth()).astype(np.uint16) for gain in (1.0, 0.2))
    first, second = grays(recorded([bright, dark], "mono16"), tmp_path)
    np.testing.assert_array_equal(first, bright >> (bits - 8))
    np.testing.assert_array_equal(second, dark >> (bits - 8))
    assert len(np.unique(first)) > 200


def test_thermal_images_are_stretched_alike(tmp_path):
    first, second = ((7000 + 900 * smooth() + shift).astype(np.uint16) for shift in (0, 50))
    gray, later = grays(recorded([first, second], "mono16"), tmp_path)
    assert len(np.unique(gray)) > 200
    assert 10 <= np.median(later.astype(int) - gray) <= 16


def test_a_brighter_frame_later_is_not_saturated(tmp_path):
    dark = (250 * smooth()).astype(np.uint16)
    bright = (4095 * smooth()).astype(np.uint16)
    assert grays(recorded([dark] * 17 + [bright], "mono16"), tmp_path)[-1].max() == 255
    assert len(np.unique(grays(recorded([dark] * 17 + [bright], "mono16"), tmp_path / "b")[-1])) > 200


@pytest.mark.parametrize(
    ("encoding", "conversion"),
    [("bgr16", cv2.COLOR_BGR2GRAY), ("rgba16", cv2.COLOR_RGBA2GRAY), ("bayer_rggb16", None)],
)
def test_other_encodings_of_16_bits(tmp_path, encoding, conversion):
    channels = {"bgr16": 3, "rgba16": 4, "bayer_rggb16": 1}[encoding]
    plain = np.repeat(np.rint(255 * smooth()).astype(np.uint8)[..., None], channels, axis=2)
    (gray,) = grays(recorded([plain.astype(np.uint16) << 4 | 15], encoding), tmp_path)
    expected = plain[..., 0] if conversion is None else cv2.cvtColor(plain, conversion)
    assert np.abs(gray.astype(int) - expected)[2:-2, 2:-2].max() <= 3


def test_a_compressed_mosaic_is_made_gray(tmp_path):
    """Of a red wall: a quarter of the pixels are bright."""
    mosaic = np.zeros(SIZE[::-1], np.uint8)
    mosaic[::2, ::2] = 200
    made = Recorded("mcap")
    png = cv2.imencode(".png", mosaic)[1].tobytes()
    made.compressed("/cam/image_raw/compressed", BEGIN, png, "bayer_rggb8; png compressed bayer_rggb8")
    (gray,) = grays(made, tmp_path)
    assert np.abs(gray[4:-4, 4:-4].astype(float) - 0.299 * 200).max() <= 2


@pytest.mark.parametrize("encoding", ["nv21", "8UC2", "bayer_rgbw8", "64FC1"])
def test_other_encodings_are_refused_by_name(tmp_path, encoding):
    made = recorded([np.zeros((*SIZE[::-1], 2), np.uint8)], encoding)
    with pytest.raises(EpipoleError, match=encoding):
        grays(made, tmp_path)
