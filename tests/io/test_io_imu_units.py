"""Logs of IMUs in another unit, without gravity, out of order or doubled: refused with the unit's name, or sorted and said."""

import numpy as np
import pytest

from epipole.errors import FileFormatError
from epipole.geometry import Rigid3
from epipole.io.sequences.imu_logs import read_imu
from epipole.synthetic.inertial import imu_along

RATE_S = 0.005


def carried(**options):
    """Rows of a unit that is carried by hand: it tilts by some tens of degrees per second."""
    seconds = np.arange(0.0, 6.0, 0.1)
    swing = np.stack([0.3 * np.sin(1.1 * seconds), 0.2 * np.cos(0.7 * seconds), 0.1 * seconds], axis=1)
    tilt = np.stack([0.5 * np.sin(0.9 * seconds), 0.4 * np.cos(1.3 * seconds), 0.2 * seconds], axis=1)
    log = imu_along(
        seconds, Rigid3.exp(np.concatenate([swing, tilt], axis=1)).inverse(), Rigid3.identity(), 0
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
        (lambda t: t[:, 4:].__itruediv__(9.80665), "probably in g .*9.80665"),
        (lambda t: t[:, 4:].__itruediv__(0.00980665), "thousandths of g"),
        (lambda t: t[:, 4:].__imul__(1670.0), "raw counts"),
        (lambda t: t[:, 4:].__imul__(0.0), "gravity was removed"),
        (lambda t: t[:, 1:4].__imul__(180 / np.pi), "degrees per second"),
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


def test_slow_turns_in_degrees_are_known_by_gravity(table, tmp_path):
    """At 2 to 5 degrees per second the size alone shows nothing."""
    seconds = np.arange(0.0, 20.0, 0.1)
    tilt = np.stack([0.3 * np.sin(0.2 * seconds), 0.2 * np.cos(0.15 * seconds), 0 * seconds], axis=1)
    still = np.zeros((len(seconds), 3))
    log = imu_along(
        seconds, Rigid3.exp(np.concatenate([still, tilt], axis=1)).inverse(), Rigid3.identity(), 0
    )
    slow = np.column_stack([log.timestamp_s, np.degrees(log.gyro_rad_s), log.accel_m_s2])
    assert np.median(np.linalg.norm(slow[:, 1:4], axis=1)) < 5.0
    with pytest.raises(FileFormatError, match="agree with them if read as degrees per second"):
        read_imu(written(tmp_path / "imu.txt", slow))


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
