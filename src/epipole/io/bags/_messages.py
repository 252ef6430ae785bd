"""Topics, first messages and time stamps of a recording."""

from __future__ import annotations

from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

from epipole.errors import FileFormatError
from epipole.io.bags import _images as images
from epipole.io.bags._files import BagMessage, OpenBag
from epipole.io.bags._topics import BagTopic
from epipole.io.images.deep_pixels import GrayScale
from epipole.io.images.pixels import MOST_SAMPLED

_FIRST_MESSAGES = 5


def topics_of(bag: OpenBag) -> tuple[BagTopic, ...]:
    """The topics that have messages, by name."""
    kinds = {images.CAMERA_INFO: "camera", images.IMU: "imu"}
    found = []
    for name, kind in bag.kinds.items():
        if not bag.counts[name]:
            continue
        what: Any = kinds.get(kind, "other")
        if kind in (images.IMAGE, images.COMPRESSED):
            what = "depth" if images.is_depth(name, images.encoding_of(first_message(bag, name))) else "image"
        found.append(BagTopic(name, what, kind, bag.counts[name]))
    return tuple(sorted(found, key=lambda t: t.name))


def first_message(bag: OpenBag, topic: str) -> Any:
    """The first readable message.

    Raises:
        FileFormatError: none of the first messages is readable.
    """
    problem = FileFormatError(bag.path, f"{topic} has no messages")
    for message in islice(bag.messages([topic]), _FIRST_MESSAGES):
        try:
            return bag.content(message)
        except FileFormatError as error:
            problem = error
    raise problem


def gray_scale_of(bag: OpenBag, topic: str) -> GrayScale | None:
    """Conversion to 8 bits that suits the first images; None if they have 8 bits."""
    contents: list[Any] = []
    for message in islice(bag.messages([topic]), MOST_SAMPLED):
        with suppress(FileFormatError):
            contents.append(bag.content(message))
    with suppress(FileFormatError):  # raised again when the image is read
        return images.gray_scale(bag.path, topic, contents)
    return None


def size_of(path: Path, topic: str, message: Any) -> tuple[int, int]:
    """Width and height of an image."""
    height, width = images.gray_of(path, topic, message).shape
    return width, height


def stamped(bag: OpenBag, message: BagMessage) -> tuple[float, Any]:
    """Time in seconds and content of a message; for a damaged one, the recording time and the error."""
    try:
        content = bag.content(message)
        return stamp_s(content, message), content
    except FileFormatError as error:
        return message.recorded_ns * 1e-9, error


def stamp_s(content: Any, message: BagMessage) -> float:
    """Time from the header, or the recording time if the driver left it at zero."""
    stamp = content.header.stamp
    ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    return (ns or message.recorded_ns) * 1e-9
