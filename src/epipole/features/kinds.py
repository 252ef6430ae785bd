"""Kinds of descriptors, how they are compared, and what a detector and a matcher are."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Int32, UInt8

from epipole.config import FeatureConfig, MatchConfig
from epipole.errors import ShapeError
from epipole.features.features import Features


class Metric(Enum):
    """Distance between two descriptors."""

    ANGLE = "angle"
    """Angle between vectors of one length, in radians."""
    HAMMING = "hamming"
    """Number of bits that differ."""


class DescriptorKind(NamedTuple):
    """Width and metric of one kind of descriptor."""

    name: str
    width: int
    """Bytes of a descriptor."""
    metric: Metric


SIFT = DescriptorKind("sift", 128, Metric.ANGLE)
ORB = DescriptorKind("orb", 32, Metric.HAMMING)
KINDS = {kind.name: kind for kind in (SIFT, ORB)}


def kind_of(descriptors: UInt8[np.ndarray, "n d"]) -> DescriptorKind:
    """The kind of descriptors of this width.

    Raises:
        ShapeError: no kind has it.
    """
    for kind in KINDS.values():
        if kind.width == descriptors.shape[1]:
            return kind
    known = " or ".join(f"{kind.width} ({kind.name})" for kind in KINDS.values())
    raise ShapeError(f"descriptors must have {known} columns, got {descriptors.shape[1]}")


class Detector(Protocol):
    """Finds and describes the features of a gray image."""

    def __call__(self, gray: UInt8[np.ndarray, "h w"], config: FeatureConfig) -> Features:
        """Features in pixels of the image."""


class Matcher(Protocol):
    """Pairs the rows of two arrays of descriptors of one kind."""

    def __call__(
        self, first: UInt8[np.ndarray, "n d"], second: UInt8[np.ndarray, "m d"], config: MatchConfig
    ) -> Int32[np.ndarray, "k 2"]:
        """Pairs of rows, each row in one pair at most."""
