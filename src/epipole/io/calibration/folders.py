"""Folders that hold the calibration of several cameras in one file each."""

from __future__ import annotations

from pathlib import Path

from epipole.errors import FileFormatError

OWN, OWN_ROS = ("calibration.json",), ("ros_left.yaml", "ros_right.yaml")
"""Files that `epipole calibrate` writes."""
GROUPS = (OWN, OWN_ROS, ("left.yaml", "right.yaml"), ("left.yml", "right.yml"))
"""Files of a calibration, left camera first: of `epipole calibrate` and of ROS' camera_calibration."""


def calibration_files(path: Path) -> list[Path]:
    """The path itself, or the files of the calibration in a folder.

    Raises:
        FileFormatError: a folder has no such files, or those of several calibrations.
    """
    if not path.is_dir():
        return [path]
    whole = [group for group in GROUPS if all((path / name).is_file() for name in group)]
    if not whole:
        known = ", ".join(" and ".join(group) for group in GROUPS)
        raise FileFormatError(path, f"a folder without a calibration: expected {known}")
    is_own = whole == [OWN, OWN_ROS]  # one calibration, written twice
    if len(whole) > 1 and not is_own:
        names = " or ".join(" and ".join(group) for group in whole)
        raise FileFormatError(path, f"the folder has several calibrations: pass the files, {names}")
    return [path / name for name in whole[0]]
