"""Selection of a recording's topics: one camera, a stereo pair, or images and depth."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from epipole.errors import ConfigError
from epipole.io.sequences.stereo_folders import side_of

BagSensor = Literal["mono", "stereo", "rgbd"]
_COMPRESSED = ("/compressed", "/compressedDepth")
_OF_ONE_CAMERA = (
    "image_rect",
    "image_rect_raw",
    "image_rect_color",
    "image_mono",
    "image_raw",
    "image_color",
    "image",
)
"""Image topics of one camera in one namespace, best first: rectified images have no distortion."""
_LONGEST_LIST = 4000
"""Most characters of a topic list in an error message."""


@dataclass(frozen=True, slots=True)
class BagTopic:
    """A topic of a recording."""

    name: str
    kind: Literal["image", "depth", "camera", "imu", "other"]
    message: str
    """Message type, such as `sensor_msgs/msg/Image`."""
    num_messages: int

    def __str__(self) -> str:
        return f"{self.name} ({self.num_messages} of {self.message.split('/')[-1]}, {self.kind})"


def base_name(topic: str) -> str:
    """The topic name without its compression suffix."""
    for suffix in _COMPRESSED:
        topic = topic.removesuffix(suffix)
    return topic


def is_rectified(topic: str) -> bool:
    """Whether a topic's name says that its images are rectified."""
    return "rect" in base_name(topic).rpartition("/")[2]


def choose_topics(
    path: Path, topics: Sequence[BagTopic], sensor: str, requested: Sequence[str]
) -> tuple[BagSensor, tuple[str, ...]]:
    """The sensor configuration and its topics: images; left, right; or images, depth.

    Args:
        path: the recording, for error messages.
        topics: all topics with messages.
        sensor: auto, mono, stereo or rgbd.
        requested: one or two names chosen by the user; empty: find them.

    Raises:
        ConfigError: no topics match, or the choice is ambiguous; the message lists all topics.
    """
    if requested:
        return _as_requested(path, topics, sensor, requested)
    images = _best([t.name for t in topics if t.kind == "image"])
    depths = _best([t.name for t in topics if t.kind == "depth"])
    registered = [name for name in depths if "aligned" in name or "registered" in name]
    depths = registered or depths
    pairs = _pairs(images)
    colors = [name for name in images if "infra" not in name] or images
    if sensor == "rgbd" or (sensor == "auto" and depths and colors):
        return "rgbd", _only(path, topics, "rgbd", [(color, depth) for color in colors for depth in depths])
    if sensor == "stereo" or (sensor == "auto" and pairs):
        return "stereo", _only(path, topics, "stereo", pairs)
    if len(images) > 1 and len(pairs) == 1:
        images = [name for name in images if name != pairs[0][1]]
    return "mono", _only(path, topics, "mono", [(name,) for name in images])


def _as_requested(
    path: Path, topics: Sequence[BagTopic], sensor: str, requested: Sequence[str]
) -> tuple[BagSensor, tuple[str, ...]]:
    kinds = {t.name: t.kind for t in topics}
    names = tuple(name if name in kinds else f"/{name}" for name in requested)
    wrong = [name for k, name in enumerate(names) if kinds.get(name) not in ("image", *["depth"] * (k == 1))]
    if wrong or len(names) > 2 or len(set(names)) < len(names):
        what = f"{', '.join(wrong)} has no images" if wrong else "topics must be one or two different names"
        raise ConfigError(
            f"{path}: {what}; pass IMAGES, LEFT,RIGHT or IMAGES,DEPTH from {listed_topics(topics)}"
        )
    found: BagSensor = "mono"
    if len(names) == 2:
        found = "rgbd" if kinds[names[1]] == "depth" else "stereo"
    if sensor not in ("auto", found):
        raise ConfigError(f"{path}: the topics {', '.join(names)} are {found}, not {sensor}")
    return found, names


def _only(
    path: Path, topics: Sequence[BagTopic], what: str, choices: Sequence[tuple[str, ...]]
) -> tuple[str, ...]:
    if len(choices) == 1:
        return choices[0]
    if not choices:
        raise ConfigError(f"{path}: no topics for {what} found; choose topics from {listed_topics(topics)}")
    several = _shortened(" or ".join(",".join(choice) for choice in choices))
    raise ConfigError(
        f"{path}: several topics are possible, {several}: choose topics from {listed_topics(topics)}"
    )


def image_topics(topics: Sequence[BagTopic]) -> list[str]:
    """The best image topic of each camera, by name: a number in it counts as such."""
    return sorted(
        _best([t.name for t in topics if t.kind == "image"]),
        key=lambda name: [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)],
    )


def listed_topics(topics: Sequence[BagTopic]) -> str:
    """The topics of a recording as text, those with images first."""
    ordered = sorted(topics, key=lambda t: (t.kind not in ("image", "depth"), t.name))
    return _shortened("; ".join(map(str, ordered)))


def _shortened(text: str) -> str:
    """Limit the length of a text: recordings may have many topics with long names."""
    return text if len(text) <= _LONGEST_LIST else f"{text[:_LONGEST_LIST]} ..."


def _best(names: Sequence[str]) -> list[str]:
    """The best topic where the same images have several names: uncompressed and rectified."""
    found: dict[str, tuple[tuple[int, bool], str]] = {}
    for name in names:
        space, _, last = base_name(name).rpartition("/")
        is_usual = last in _OF_ONE_CAMERA
        rank = (_OF_ONE_CAMERA.index(last) if is_usual else 0, name != base_name(name))
        key = space if is_usual else base_name(name)
        found[key] = min(found.get(key, (rank, name)), (rank, name))
    return sorted(name for _, name in found.values())


def _pairs(names: Sequence[str]) -> list[tuple[str, ...]]:
    sides = {
        side: {key: name for name in names if (key := side_of(name, side))} for side in ("left", "right")
    }
    return [(left, sides["right"][key]) for key, left in sides["left"].items() if key in sides["right"]]
