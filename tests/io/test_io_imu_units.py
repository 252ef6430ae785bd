"""IMU logs in another unit (converted if it is certain or stated, else refused), without gravity, out of order or doubled."""

import numpy as np
import pytest

from epipole.config import AnchorOptions
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3
from epipole.io.sequences.imu_logs import read_imu
from epipole.scale import check_anchor_files, mounted_imu
from epipole.synthetic.inertial import imu_along, inertial_path

RATE_S = 0.005
IN_DEGREES = "imu.txt: its angular velocities are in degrees per second; they were converted to rad/s"
IN_G = "imu.txt: its accelerations are in g; they were converted to m/s^2"


def carried(duration_s=6.0, **options):
    """Rows of an IMU that is carried by hand: it tilts by some tens of degrees per second."""
    seconds = np.arange(0.0, duration_s, 0.1)
    swing = np.stack([0.3 * np.sin(1.1 * seconds), 0.2 * np.cos(0.7 * seconds), 0.1 * seconds], axis=1)
    tilt = np.stack([0.5 * np.sin(0.9 * seconds), 0.4 * np.cos(1.3 * seconds), 0.2 * seconds], axis=1)
    log = imu_along(
        seconds, Rigid3.exp(np.concatenate([swing, tilt], axis=1)).inverse(), Rigid3.identity(), 0, **options
    )
    return np.column_stack([log.timestamp_s, log.gyro_rad_s, log.accel_m_s2])


@pytest.fixture
def table():
    return carried()


def written(path, table):
    np.savetxt(path, table, "%.12g")
    return path


def test_a_sound_log_is_read_without_a_word(table, tmp_path):
    log, _ = read_imu(written(tmp_path / "imu.txt", table))
    assert log.notes == () and len(log) == len(table)
    np.testing.assert_allclose(log.accel_m_s2, table[:, 4:], rtol=1e-9)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t[:, 4:].__itruediv__(9.80665), "probably in g .*--imu-units g"),
        (lambda t: t[:, 4:].__itruediv__(0.00980665), "thousandths of g .*--imu-units mg"),
        (lambda t: t[:, 4:].__imul__(1670.0), "raw counts"),
        (lambda t: t[:, 4:].__imul__(0.0), "gravity was removed"),
        (
            lambda t: t.__setitem__((slice(None), slice(1, None)), t[:, [4, 5, 6, 1, 2, 3]]),
            "wx wy wz, ax ay az",
        ),
        (lambda t: t[:, 0].__imul__(1e3), "milliseconds"),
        (lambda t: t[:, 0].__imul__(1e6), "microseconds"),
    ],
)
def test_another_unit_is_named(table, tmp_path, change, words):
    change(table)
    with pytest.raises(FileFormatError, match=words):
        read_imu(written(tmp_path / "imu.txt", table))


def test_gravity_that_was_taken_out_is_named(tmp_path):
    for factor in (0.02, 0.1, 0.3):  # slow and fast motions
        table = carried(gravity_in_world=(0.0, 0.0, 0.0))
        table[:, 4:] *= factor
        with pytest.raises(FileFormatError, match="gravity was removed"):
            read_imu(written(tmp_path / "imu.txt", table))


def test_slow_rotations_in_degrees_are_known_by_gravity(tmp_path):
    """At 2 to 5 degrees per second the size alone shows nothing."""
    seconds = np.arange(0.0, 20.0, 0.1)
    tilt = np.stack([0.3 * np.sin(0.2 * seconds), 0.2 * np.cos(0.15 * seconds), 0 * seconds], axis=1)
    still = np.zeros((len(seconds), 3))
    log = imu_along(
        seconds, Rigid3.exp(np.concatenate([still, tilt], axis=1)).inverse(), Rigid3.identity(), 0
    )
    slow = np.column_stack([log.timestamp_s, np.degrees(log.gyro_rad_s), log.accel_m_s2])
    assert np.median(np.linalg.norm(slow[:, 1:4], axis=1)) < 5.0
    log_read, _ = read_imu(written(tmp_path / "imu.txt", slow))
    np.testing.assert_allclose(log_read.gyro_rad_s, log.gyro_rad_s, atol=1e-9)
    assert log_read.notes == (IN_DEGREES,)


@pytest.mark.parametrize(("unit", "name"), [(1e9, None), (1e6, "microseconds"), (1e3, "milliseconds")])
def test_a_computers_clock_shows_its_unit(table, tmp_path, unit, name):
    table[:, 0] = np.rint((table[:, 0] + 1.4e9) * unit)
    np.savetxt(tmp_path / "imu.txt", table, ["%d"] + 6 * ["%.9g"])
    log, _ = read_imu(tmp_path / "imu.txt")
    assert np.allclose(np.diff(log.timestamp_s), RATE_S, atol=1e-3)
    assert log.notes == (() if name is None else (f"imu.txt: its times are in {name}",))


def test_nanoseconds_since_the_start_of_a_phone(table, tmp_path):
    for hours in (1, 60):
        rows = table.copy()
        rows[:, 0] = np.rint((rows[:, 0] + 3600 * hours) * 1e9)
        np.savetxt(tmp_path / "imu.txt", rows, ["%d"] + 6 * ["%.9g"])
        log, _ = read_imu(tmp_path / "imu.txt")
        np.testing.assert_allclose(log.timestamp_s, table[:, 0] + 3600 * hours, atol=1e-6)


def test_rows_out_of_order_are_sorted_and_doubled_ones_dropped(table, tmp_path, rng):
    shuffled = table[rng.permutation(len(table))]
    log, _ = read_imu(written(tmp_path / "imu.txt", np.concatenate([shuffled, shuffled[:3]])))
    np.testing.assert_allclose(log.timestamp_s, table[:, 0], atol=1e-9)
    np.testing.assert_allclose(log.gyro_rad_s, table[:, 1:4], rtol=1e-9)
    assert "were sorted by time" in log.notes[0] and "3 samples repeat a time" in log.notes[1]
    swapped = np.concatenate([table[600:], table[:600]])  # two parts in the wrong order
    log, _ = read_imu(written(tmp_path / "imu.txt", swapped))
    assert "1 samples are earlier" in log.notes[0] and len(log) == len(table)


def test_two_recordings_in_one_file_are_refused(table, tmp_path):
    again = table.copy()
    again[:, 0] += 0.0012
    with pytest.raises(FileFormatError, match="several recordings"):
        read_imu(written(tmp_path / "imu.txt", np.concatenate([table, again])))


def in_units(log, accel=1.0, gyro=1.0):
    return np.column_stack([log.timestamp_s, log.gyro_rad_s / gyro, log.accel_m_s2 / accel])


@pytest.mark.parametrize("seed", range(4))
def test_g_and_degrees_of_a_long_log_are_converted(seed, tmp_path):
    """Strong motion by hand: the norm of single accelerations is far from 1 g."""
    truth = inertial_path(seed, 40.0).log
    for accel, gyro, notes in (
        (9.80665, 1.0, (IN_G,)),
        (1.0, np.pi / 180, (IN_DEGREES,)),
        (9.80665, np.pi / 180, (IN_DEGREES, IN_G)),
        (1.0, 1.0, ()),
    ):
        log, _ = read_imu(written(tmp_path / "imu.txt", in_units(truth, accel, gyro)))
        assert log.notes == notes
        np.testing.assert_allclose(log.accel_m_s2, truth.accel_m_s2, atol=1e-8)
        np.testing.assert_allclose(log.gyro_rad_s, truth.gyro_rad_s, atol=1e-8)


@pytest.mark.parametrize(
    ("accel", "gyro"),
    [
        (9.80665 / 1.1, 1.0),  # neither g nor m/s^2
        (1.0, np.pi / 180 / 2.0),  # twice degrees per second
        (1.0, np.pi / 180 / 131.0),  # counts of a common gyroscope
        (1.0, 1e-3),  # thousandths
    ],
)
def test_units_that_are_not_certain_are_refused(accel, gyro, tmp_path):
    for seed in range(4):
        table = in_units(inertial_path(seed, 40.0).log, accel, gyro)
        with pytest.raises(FileFormatError, match="imu-units"):
            read_imu(written(tmp_path / "imu.txt", table))


def test_swapped_columns_and_g_with_degrees_are_both_named(tmp_path):
    """A rotation about the vertical: gravity shows nothing."""
    times = np.arange(0.0, 10.0, RATE_S)
    rows = np.column_stack([times, np.tile([0.0, 0.0, 12.0, 0.0, 0.0, 1.0], (len(times), 1))])
    with pytest.raises(
        FileFormatError, match="wx wy wz, ax ay az, or state the units with --imu-units g,deg/s"
    ):
        read_imu(written(tmp_path / "imu.txt", rows))
    log, _ = read_imu(tmp_path / "imu.txt", "g,deg/s")
    np.testing.assert_allclose(log.gyro_rad_s[:, 2], np.radians(12.0))


def test_a_vehicle_without_gravity_is_not_in_g(tmp_path):
    """It accelerates by 1 m/s^2 for 15 s, then brakes as hard: the norm is that of gravity in g."""
    times = np.arange(0.0, 40.0, RATE_S)
    accel = np.where(times < 15.0, 1.0, -1.0)[:, None] * np.array([1.0, 0.0, 0.0])
    table = np.column_stack([times, np.zeros((len(times), 3)), accel])
    with pytest.raises(FileFormatError, match=r"probably in g .* or gravity was removed"):
        read_imu(written(tmp_path / "imu.txt", table))


def test_stated_units_are_converted_and_still_checked(table, tmp_path):
    rows = table.copy()
    rows[:, 1:4] *= 180 / np.pi
    rows[:, 4:] /= 0.00980665
    log, _ = read_imu(written(tmp_path / "imu.txt", rows), "mg, deg/s")
    assert log.notes == ()
    np.testing.assert_allclose(log.accel_m_s2, table[:, 4:], rtol=1e-9)
    np.testing.assert_allclose(log.gyro_rad_s, table[:, 1:4], rtol=1e-9)
    with pytest.raises(FileFormatError, match="median norm of its accelerations is 9"):
        read_imu(written(tmp_path / "imu.txt", table), "g")
    with pytest.raises(FileFormatError, match="rotate gravity's direction"):
        read_imu(written(tmp_path / "imu.txt", rows), "mg,rad/s")
    with pytest.raises(ConfigError, match="one of rad/s, deg/s, such as g,deg/s, got 'g,rpm'"):
        read_imu(tmp_path / "imu.txt", "g,rpm")


def test_a_fast_rotation_is_believed_if_its_unit_is_stated(tmp_path):
    """A spinning IMU: about the vertical, gravity shows nothing."""
    times = np.arange(0.0, 10.0, RATE_S)
    ones = np.ones((len(times), 1))
    written(tmp_path / "imu.txt", np.column_stack([times, ones * [0, 0, 30.0], ones * [0, 0, 9.81]]))
    with pytest.raises(FileFormatError, match="too fast for rad/s"):
        read_imu(tmp_path / "imu.txt")
    for unit, factor in (("rad/s", 1.0), ("deg/s", np.pi / 180)):
        log, _ = read_imu(tmp_path / "imu.txt", unit)
        np.testing.assert_allclose(log.gyro_rad_s[:, 2], 30.0 * factor)


def test_jobs_take_the_stated_units(table, tmp_path):
    rows = table.copy()
    rows[:, 4:] /= 9.80665
    (tmp_path / "mounting.yaml").write_text("T_cam_imu: [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]\n")
    files = {
        "imu": written(tmp_path / "imu.txt", rows),
        "imu_mounting": tmp_path / "mounting.yaml",
    }
    stated = AnchorOptions(**files, imu_units="g")
    check_anchor_files(stated)
    np.testing.assert_allclose(mounted_imu(stated).log.accel_m_s2, table[:, 4:], rtol=1e-9)
    with pytest.raises(FileFormatError, match="state the unit with --imu-units g"):
        check_anchor_files(AnchorOptions(**files))
    with pytest.raises(ConfigError, match="got 'pounds'"):
        check_anchor_files(AnchorOptions(**files, imu_units="pounds"))
    with pytest.raises(ConfigError, match="imu_units belongs to imu"):
        AnchorOptions(imu_units="g")
    with pytest.raises(ConfigError, match="imu_topic belongs to imu"):
        AnchorOptions(imu_topic="/imu")
