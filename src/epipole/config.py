"""Options that several parts of the package share; the command line is generated from such classes.

The options of a pipeline are in its own `config.py`. These modules import no kernels, so that the command
line's help does not wait for them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from typing import Any, Literal, TypeVar, cast

from epipole._declared import check_fields
from epipole.errors import ConfigError

Options = TypeVar("Options")
_LARGEST = 1e100


def options_of(kind: type[Options], given: Options | None, named: Mapping[str, Any] | None = None) -> Options:
    """The options given, or the defaults for None; single ones that are named override them.

    A name is that of a field, or of a field of the configs inside it where only one has it.

    Raises:
        ConfigError: something else was given, such as a dict, or a name is unknown or has a value that cannot be.
    """
    if given is not None and not isinstance(given, kind):
        hint = f"; {kind.__name__}(**it) makes one" if isinstance(given, dict) else ""
        raise ConfigError(f"options must be a {kind.__name__}, not a {type(given).__name__}{hint}")
    options = kind() if given is None else given
    if not named:
        return options
    changes: dict[str, Any] = {}
    for name in sorted(
        named, key=lambda name: name not in _names(options)
    ):  # whole configs before their parts
        if name in _names(options):
            present = getattr(options, name)
            changes[name] = options_of(type(present), named[name]) if is_dataclass(present) else named[name]
            continue
        holder = _holder_of(name, options)
        changes[holder] = _changed(changes.get(holder, getattr(options, holder)), {name: named[name]})
    return _changed(options, changes)


def _changed(options: Options, changes: Mapping[str, Any]) -> Options:
    try:
        return replace(cast(Any, options), **changes)
    except TypeError as error:  # its checks compared text with numbers
        given = ", ".join(f"{name}={value!r}" for name, value in changes.items())
        raise ConfigError(f"an option has a value of the wrong type, {given}: {error}") from error


def _holder_of(name: str, options: object) -> str:
    """The field whose config has a field of this name."""
    parts = {field: getattr(options, field) for field in _names(options)}
    parts = {field: part for field, part in parts.items() if is_dataclass(part)}
    holding = [field for field, part in parts.items() if name in _names(part)]
    if len(holding) == 1:
        return holding[0]
    if holding:
        of = " and of ".join(holding)
        example = f"{holding[-1]}={type(parts[holding[-1]]).__name__}({name}=...)"
        raise ConfigError(f"{name} is an option of {of}: say which, as in {example}")
    known = [*_names(options), *(each for part in parts.values() for each in _names(part))]
    near = get_close_matches(name, dict.fromkeys(known), 3, 0.6)
    hint = f"; did you mean {' or '.join(near)}?" if near else f"; it has {', '.join(_names(options))}"
    raise ConfigError(f"{type(options).__name__} has no option {name}{hint}")


def _names(config: Any) -> list[str]:
    return [field.name for field in fields(config)]


@dataclass(frozen=True, kw_only=True)
class FeatureConfig:
    """Options of feature detection."""

    kind: Literal["sift", "orb"] = "sift"
    """SIFT, or ORB: faster, but matches over smaller changes of viewpoint and scale."""
    max_features: int = 8192
    """Features kept per image, the largest first."""
    max_size_px: int = 3200
    """Pictures are reduced for detection until their longer side has at most this many pixels."""
    contrast_threshold: float = 0.02
    """SIFT: blobs with less contrast are ignored (in the unit of OpenCV's contrastThreshold)."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_fields(self)
        if self.max_features < 1 or self.max_size_px < 16:
            raise ConfigError("max_features must be at least 1 and max_size_px at least 16")
        if not 0 <= self.contrast_threshold < math.inf:
            raise ConfigError(
                f"contrast_threshold must be finite and not negative, got {self.contrast_threshold}"
            )


@dataclass(frozen=True, kw_only=True)
class MatchConfig:
    """Options of matching."""

    max_ratio: float = 0.8
    """Lowe's ratio: the nearest descriptor must be nearer than this times the second nearest."""
    max_distance: float = 0.7
    """SIFT: largest angle between matching descriptors, in radians."""
    max_bits: int = 64
    """ORB: largest Hamming distance of a match."""
    preemptive_features: int = 2048
    """SIFT: the largest third of both pictures' features, at most this many, are matched first (preemptive
    matching); the others then along their epipolar lines. 0: all features are matched with all."""
    preemptive_min_matches: int = 12
    """With fewer preemptive matches the pictures count as not overlapping."""
    preemptive_min_inliers: int = 30
    """With fewer preemptive inliers there is no epipolar geometry to guide: all features are matched with
    all."""
    band_px: float = 3.0
    """Guided matches lie at most this many pixels from their epipolar line."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_fields(self)
        if not 0 < self.max_ratio <= 1:
            raise ConfigError(f"max_ratio must be in (0, 1], got {self.max_ratio}")
        if self.preemptive_features < 0 or not 0 < self.band_px < math.inf:
            raise ConfigError(
                "preemptive_features must not be negative and band_px must be positive and finite"
            )


@dataclass(frozen=True, kw_only=True)
class FlowConfig:
    """Options of following points."""

    window_px: int = 21
    """Side of the patch that is compared."""
    levels: int = 4
    """Times that the picture is halved, and one more."""
    max_return_px: float = 0.7
    """A point followed there and back again ends at most so far from where it began."""
    min_eigenvalue: float = 1e-4
    """Of the patch's gradient matrix per pixel (in units of OpenCV's minEigThreshold): flatter patches are lost."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_fields(self)
        if self.window_px < 5 or self.window_px % 2 == 0 or not 1 <= self.levels <= 8:
            raise ConfigError("window_px must be odd and at least 5, levels from 1 to 8")
        if not 0 < self.max_return_px < 1e3 or not 0 <= self.min_eigenvalue < 1e3:
            raise ConfigError("max_return_px must be positive and min_eigenvalue not negative")


@dataclass(frozen=True, kw_only=True)
class RansacConfig:
    """Options of robust estimation (RANSAC)."""

    max_error_px: float = 4.0
    """Matches with a larger residual are outliers."""
    confidence: float = 0.9999
    """Stop when a sample of inliers alone has been drawn with this probability."""
    min_iterations: int = 50
    """Samples drawn at least."""
    max_iterations: int = 10_000
    """Samples drawn at most."""
    min_inliers: int = 15
    """Fewer inliers count as failure."""
    min_inlier_ratio: float = 0.0
    """Stop once this share of inliers would have been found; a smaller share may be missed, which saves time
    where it would be a failure anyway."""
    seed: int = 0
    """Seed of random sampling."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_fields(self)
        if not self.max_error_px > 0:
            raise ConfigError(f"max_error_px must be positive, got {self.max_error_px}")
        if _LARGEST < self.max_error_px < math.inf:
            raise ConfigError(f"max_error_px is too large to be calculated with: {self.max_error_px:g}")
        if not 0 < self.confidence < 1:
            raise ConfigError(f"confidence must be between 0 and 1, got {self.confidence}")
        if not 0 <= self.min_inlier_ratio <= 1:
            raise ConfigError(f"min_inlier_ratio must be between 0 and 1, got {self.min_inlier_ratio}")
        if min(self.min_iterations, self.max_iterations, self.min_inliers) < 1:
            raise ConfigError("min_iterations, max_iterations and min_inliers must be at least 1")
        if self.seed < 0:
            raise ConfigError(f"seed must not be negative, got {self.seed}")
