"""ROS topics of the cameras in a calibration file, as Kalibr states them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from epipole._checks import checked
from epipole.io.calibration.camera_chains import is_chain
from epipole.io.calibration.files import parsed_file


@checked
def camera_topics(path: str | Path) -> tuple[str, ...]:
    """The key `rostopic` of each camera of Kalibr's camchain, in the order of the cameras; empty if one is missing.

    Raises:
        FileFormatError: the file is malformed.
    """
    if Path(path).is_dir():
        return ()
    content = parsed_file(Path(path))
    if not is_chain(content):
        return ()
    cameras = (content.get(f"cam{k}") for k in range(len(content)))
    named = [own.get("rostopic") for own in cameras if isinstance(own, Mapping)]
    return tuple(map(str, named)) if all(isinstance(one, str) for one in named) else ()
