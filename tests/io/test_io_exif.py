"""Focal length, place and time from EXIF."""

from datetime import datetime

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from epipole.io.images.exif import (
    GpsPosition,
    camera_of,
    capture_time_of,
    focal_of,
    gimbal_up_of,
    gps_of,
    new_exif,
    orientation_of,
    upright_exif,
)
from epipole.io.images.sensor_widths import SENSOR_WIDTH_MM, camera_key, sensor_width_mm

FOCAL_MM, FOCAL_35MM, PIXEL_WIDTH, PLANE_X, PLANE_UNIT = 0x920A, 0xA405, 0xA002, 0xA20E, 0xA210


def block(details=None, gps=None, **tags):
    """An EXIF block after a trip through bytes, as a file gives it."""
    exif = Image.Exif()
    names = {"make": 0x010F, "model": 0x0110, "orientation": 0x0112, "date_time": 0x0132}
    for name, value in tags.items():
        exif[names[name]] = value
    exif.get_ifd(0x8769).update(details or {})
    exif.get_ifd(0x8825).update(gps or {})
    out = Image.Exif()
    out.load(exif.tobytes())
    return out


def test_focal_from_35mm_equivalent_is_over_the_longer_side():
    exif = block({FOCAL_35MM: 28})
    for size in ((4000, 3000), (3000, 4000)):
        focal = focal_of(exif, *size)
        assert focal is not None
        assert focal.focal_px == pytest.approx(28 / 36 * 4000)
        assert focal.source == "35 mm equivalent"


def test_focal_from_sensor_width_when_there_is_no_equivalent():
    exif = block({FOCAL_MM: IFDRational(50), FOCAL_35MM: 0}, make="NIKON CORPORATION", model="NIKON D90")
    focal = focal_of(exif, 4288, 2848)
    assert focal is not None
    assert focal.focal_px == pytest.approx(50 / 23.6 * 4288)
    assert focal.source == "sensor width"


def test_focal_from_focal_plane_resolution_follows_a_smaller_picture():
    # 4000 px over a 20 mm sensor: 200 px per mm, 5080 px per inch, 2000 px per cm.
    for unit, per_unit in ((2, 5080), (3, 2000), (4, 200)):
        details = {
            FOCAL_MM: IFDRational(10),
            PLANE_X: IFDRational(per_unit),
            PLANE_UNIT: unit,
            PIXEL_WIDTH: 4000,
        }
        exif = block(details, make="Nobody", model="Unheard of")
        full, half = focal_of(exif, 4000, 3000), focal_of(exif, 2000, 1500)
        assert full is not None
        assert half is not None
        assert full.focal_px == pytest.approx(2000.0)
        assert half.focal_px == pytest.approx(1000.0)
        assert full.source == "focal-plane resolution"


@pytest.mark.parametrize(
    "details",
    [
        {},
        {FOCAL_35MM: 0},
        {FOCAL_35MM: 7},
        {FOCAL_35MM: 721},
        {FOCAL_MM: IFDRational(5)},
        {FOCAL_MM: IFDRational(0, 0), PLANE_X: IFDRational(100), PLANE_UNIT: 3},
        {FOCAL_MM: IFDRational(5), PLANE_X: IFDRational(0), PLANE_UNIT: 3},
    ],
)
def test_absurd_focal_lengths_are_rejected(details):
    assert focal_of(block(details, make="Nobody", model="Unheard of"), 4000, 3000) is None


def test_limits_of_a_credible_focal_length():
    low, high = focal_of(block({FOCAL_35MM: 8}), 4000, 3000), focal_of(block({FOCAL_35MM: 720}), 4000, 3000)
    assert low is not None
    assert high is not None
    assert high.focal_px == pytest.approx(20 * 4000)


def test_an_absurd_equivalent_falls_through_to_the_sensor():
    exif = block({FOCAL_MM: IFDRational(50), FOCAL_35MM: 65535}, make="Canon", model="Canon EOS 5D Mark II")
    focal = focal_of(exif, 5616, 3744)
    assert focal is not None
    assert focal.focal_px == pytest.approx(50 / 36 * 5616)


def test_camera_names_and_table():
    assert camera_key("NIKON CORPORATION", "NIKON  D90") == "nikon d90"
    assert (
        camera_key("EASTMAN KODAK COMPANY", "KODAK Z612 ZOOM DIGITAL CAMERA")
        == "kodak z612 zoom digital camera"
    )
    assert camera_key("", "Thing") == "thing"
    assert sensor_width_mm("SONY", "ILCE-6000") == 23.5
    assert sensor_width_mm("SONY", "ILCE-0") is None
    assert all(4.0 < width < 37.0 and key == key.lower() for key, width in SENSOR_WIDTH_MM.items())
    assert camera_of(block(make=" Canon \x00", model="Canon EOS 7D")) == ("Canon", "Canon EOS 7D")
    assert camera_of(block()) == ("", "")


@pytest.mark.parametrize(("value", "expected"), [(6, 6), (1, 1), (8, 8), (0, 1), (9, 1), (77, 1)])
def test_orientation(value, expected):
    assert orientation_of(block(orientation=value)) == expected
    assert orientation_of(block()) == 1


@pytest.mark.parametrize(("north", "east"), [("N", "E"), ("S", "E"), ("N", "W"), ("S", "W")])
def test_gps_signs(north, east):
    dms = (IFDRational(33), IFDRational(30), IFDRational(3600, 100))
    position = gps_of(block(gps={1: north, 2: dms, 3: east, 4: dms, 5: b"\x01", 6: IFDRational(25, 2)}))
    value = 33 + 30 / 60 + 36 / 3600
    assert position is not None
    assert position.lat_deg == pytest.approx(value if north == "N" else -value)
    assert position.lon_deg == pytest.approx(value if east == "E" else -value)
    assert position.alt_m == pytest.approx(-12.5)


def test_gps_without_altitude_and_decimal_minutes():
    dm = (IFDRational(10), IFDRational(303, 10), IFDRational(0))
    position = gps_of(block(gps={1: "N", 2: dm, 3: "E", 4: dm}))
    assert position == GpsPosition(pytest.approx(10.505), pytest.approx(10.505), None)


@pytest.mark.parametrize(
    "gps",
    [
        {},
        {1: "N", 2: (IFDRational(10), IFDRational(0), IFDRational(0))},
        {1: "N", 2: (IFDRational(0),) * 3, 3: "E", 4: (IFDRational(0),) * 3},
        {1: "N", 2: (IFDRational(95),) * 3, 3: "E", 4: (IFDRational(9),) * 3},
        {1: "N", 2: (IFDRational(0, 0),) * 3, 3: "E", 4: (IFDRational(9),) * 3},
        {1: "N", 2: (IFDRational(9),) * 3, 3: "E", 4: (IFDRational(9),) * 3, 9: "V"},
    ],
)
def test_unusable_gps_is_none(gps):
    assert gps_of(block(gps=gps)) is None


def test_capture_time():
    exif = block({0x9003: "2020:02:29 23:59:58", 0x9291: "25"}, date_time="2021:01:01 00:00:00")
    assert capture_time_of(exif) == datetime(2020, 2, 29, 23, 59, 58, 250000)
    assert capture_time_of(
        block({0x9003: "    :  :     :  :  "}, date_time="2021:01:01 00:00:00")
    ) == datetime(2021, 1, 1)
    assert capture_time_of(block()) is None
    assert capture_time_of(block({0x9003: "2021:13:01 00:00:00"})) is None


def test_new_exif_is_read_back():
    position = GpsPosition(-33.8567844, 151.2152967, -4.25)
    exif = Image.Exif()
    exif.load(new_exif("Maker", "Model", 35.4, position).tobytes())
    focal, back = focal_of(exif, 3600, 2400), gps_of(exif)
    assert camera_of(exif) == ("Maker", "Model")
    assert focal is not None
    assert focal.focal_px == pytest.approx(3500.0)
    assert back is not None
    np.testing.assert_allclose(np.array(back, float), np.array(position, float), atol=1e-9)


def test_upright_exif_keeps_facts_and_drops_orientation():
    details = {FOCAL_MM: IFDRational(50), 0x9003: "2020:02:29 23:59:58", 0x927C: b"maker" * 100}
    dms = (IFDRational(33), IFDRational(30), IFDRational(36))
    exif = block(details, {1: "S", 2: dms, 3: "E", 4: dms}, make="Canon", model="Canon EOS 7D", orientation=6)
    upright = Image.Exif()
    upright.load(upright_exif(exif).tobytes())
    assert orientation_of(upright) == 1
    assert 0x927C not in upright.get_ifd(0x8769)
    for fact in (camera_of, gps_of, capture_time_of, lambda e: focal_of(e, 5184, 3456)):
        assert fact(upright) == fact(exif) is not None


@pytest.mark.parametrize(
    ("xmp", "up"),
    [
        (b'<x drone-dji:GimbalRollDegree="+0.00" drone-dji:GimbalPitchDegree="-90.00"/>', (0.0, 0.0, -1.0)),
        (b"<drone-dji:GimbalPitchDegree>+0.0</drone-dji:GimbalPitchDegree>", (0.0, -1.0, 0.0)),
        (b'GimbalPitchDegree="-30.0"', (0.0, -np.cos(np.pi / 6), -0.5)),
        (b'GimbalRollDegree="90" GimbalPitchDegree="0"', (-1.0, 0.0, 0.0)),
        (b'GimbalPitchDegree="-900"', None),
        (b'GimbalPitchDegree="x"', None),
        (b"\xff\xfe", None),
        (None, None),
    ],
)
def test_a_gimbal_measures_up(xmp, up) -> None:
    found = gimbal_up_of(xmp)
    assert (found is None) == (up is None)
    if up is not None:
        np.testing.assert_allclose(found, up, atol=1e-12)
