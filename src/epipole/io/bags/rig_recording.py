"""Reading ROS recordings as frames of a rig: one image topic per camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from epipole._checks import checked
from epipole.errors import ConfigError, FileFormatError
from epipole.io.bags import _images as images
from epipole.io.bags._files import opened_bag
from epipole.io.bags._messages import first_message, gray_scale_of, size_of, stamped, topics_of
from epipole.io.bags._pairing import grouped
from epipole.io.bags._topics import BagTopic, base_name, image_topics, listed_topics
from epipole.io.bags.recording import PAIR_TOLERANCE_S
from epipole.io.images.deep_pixels import GrayScale


@dataclass(frozen=True, slots=True, eq=False)
class BagRig:
    """The image topics of a rig's cameras."""

    path: Path
    topics: tuple[str, ...]
    """One per camera, in the order of the cameras."""
    num_frames: int
    """Number of messages of the topic with the fewest."""
    sizes: tuple[tuple[int, int], ...]
    """Width and height of each camera's images."""
    scales: tuple[GrayScale | None, ...]
    """Conversion of 16-bit images to 8 bits by topic, common to all its images."""
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class BagRigFrame:
    """Images of one instant; they are decoded on access, and raise FileFormatError if damaged."""

    timestamp_s: float
    """Of the first camera."""
    grays: tuple[Callable[[], UInt8[np.ndarray, "h w"]], ...]


@checked
def read_bag_rig(
    path: str | Path, num_cameras: int, topics: Sequence[str] = (), calibrated: Sequence[str] = ()
) -> BagRig:
    """Find the image topics of a rig.

    Args:
        path: the recording.
        num_cameras: number of cameras.
        topics: one image topic per camera, in the order of the cameras. Empty: those of `calibrated`, else all image topics, by
            name, if there are as many.
        calibrated: the topics with which the cameras were calibrated; if the recording does not have them, there is a warning.

    Raises:
        FileFormatError: the recording is unreadable.
        ConfigError: the topics do not exist, or there are more or fewer of them than cameras.
        MissingDependencyError: the package rosbags is not installed.
    """
    path = Path(path)
    with opened_bag(path) as bag:
        known = topics_of(bag)
        stated = () if topics else _present(known, calibrated)
        names = _chosen(path, known, num_cameras, topics or stated)
        notes = [] if topics or stated or not calibrated else [_guessed(names, calibrated)]
        sizes = tuple(size_of(path, name, first_message(bag, name)) for name in names)
        scales = tuple(gray_scale_of(bag, name) for name in names)
        count = min(topic.num_messages for topic in known if topic.name in names)
        return BagRig(path, names, count, sizes, scales, (*bag.warnings, *notes))


def _present(known: Sequence[BagTopic], names: Sequence[str]) -> tuple[str, ...]:
    """The topics of these names, which may be recorded as compressed images; empty unless the recording has all of them."""
    by_name = {base_name(topic.name): topic.name for topic in known if topic.kind == "image"}
    by_name |= {topic.name: topic.name for topic in known if topic.kind == "image"}
    found = [by_name.get(f"/{name.lstrip('/')}") for name in names]
    return tuple(name for name in found if name) if all(found) else ()


def _guessed(names: Sequence[str], calibrated: Sequence[str]) -> str:
    pairs = ", ".join(f"{name} is camera {k}" for k, name in enumerate(names))
    return (
        f"the recording does not have the topics of the calibration ({', '.join(calibrated)}), so they were assigned by name: "
        f"{pairs}. Check it, or pass --topics"
    )


def _chosen(
    path: Path, known: Sequence[BagTopic], num_cameras: int, requested: Sequence[str]
) -> tuple[str, ...]:
    usable = {topic.name for topic in known if topic.kind == "image"}
    names = [name if name in usable else f"/{name}" for name in requested] or image_topics(known)
    if wrong := [name for name in names if name not in usable]:
        raise ConfigError(f"{path}: {', '.join(wrong)} has no images; topics are {listed_topics(known)}")
    if len(names) != num_cameras or len(set(names)) < len(names):
        raise ConfigError(
            f"{path}: the calibration has {num_cameras} cameras, so as many image topics are needed, in the same order, "
            f"but got {', '.join(names) or 'none'}; choose topics from {listed_topics(known)}"
        )
    return tuple(names)


@checked
def bag_rig_frames(bag: BagRig) -> Iterator[BagRigFrame]:
    """The frames of a rig in recorded order, with the stamps from their headers.

    Messages belong together if their stamps differ by at most 5 ms; those without a partner in every other topic are skipped.

    Raises:
        FileFormatError: the recording is damaged from here on; the frames before are valid.
    """
    with opened_bag(bag.path) as opened:
        rows = ((bag.topics.index(m.topic), *stamped(opened, m)) for m in opened.messages(bag.topics))
        for time_s, contents in grouped(rows, len(bag.topics), PAIR_TOLERANCE_S):
            yield BagRigFrame(time_s, tuple(partial(_gray, bag, k, one) for k, one in enumerate(contents)))


def _gray(bag: BagRig, camera: int, content: Any) -> UInt8[np.ndarray, "h w"]:
    if isinstance(content, FileFormatError):
        raise content
    return images.gray_of(bag.path, bag.topics[camera], content, bag.scales[camera])
