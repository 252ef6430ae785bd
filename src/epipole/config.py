"""Options that several parts of the package share; the command line is generated from such classes.

The options of a pipeline are in its own `config.py`. These modules import no kernels, so that the command
line's help does not wait for them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

from epipole._declared import check_options, did_you_mean
from epipole.errors import ConfigError

Options = TypeVar("Options")
_LARGEST = 1e100
_DICTIONARIES = ("APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11", "ARUCO_ORIGINAL")


def options_of(
    kind: type[Options],
    given: Options | None,
    named: Mapping[str, Any] | None = None,
    others: Sequence[str] = (),
) -> Options:
    """The options given, or the defaults for None; single ones that are named override them.

    A name is that of a field, or of a field of the configs inside it where only one has it.

    Args:
        kind: class of the options.
        given: the options.
        named: single ones.
        others: further names that the job knows, one of which may be meant by a name that is unknown.

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
    parts: dict[str, dict[str, Any]] = {}
    for name, value in named.items():
        if name in _names(options):
            present = getattr(options, name)
            changes[name] = options_of(type(present), value) if is_dataclass(present) else value
        else:
            parts.setdefault(_holder_of(name, options, others), {})[name] = value
    for holder, own in parts.items():  # together: one may need another
        changes[holder] = _changed(changes.get(holder, getattr(options, holder)), own)
    return _changed(options, changes)


def _changed(options: Options, changes: Mapping[str, Any]) -> Options:
    try:
        return replace(cast(Any, options), **changes)
    except TypeError as error:  # its checks compared text with numbers
        given = ", ".join(f"{name}={value!r}" for name, value in changes.items())
        raise ConfigError(f"an option has a value of the wrong type, {given}: {error}") from error


def _holder_of(name: str, options: object, others: Sequence[str]) -> str:
    """The field whose config has a field of this name."""
    parts = {field: getattr(options, field) for field in _names(options)}
    parts = {field: part for field, part in parts.items() if is_dataclass(part)}
    fitting = [field for field, part in parts.items() if name in _names(part)]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        of = " and of ".join(fitting)
        example = f"{fitting[-1]}={type(parts[fitting[-1]]).__name__}({name}=...)"
        raise ConfigError(f"{name} is an option of {of}: say which, as in {example}")
    inner = [each for part in parts.values() for each in _names(part)]
    hint = did_you_mean(name, _names(options), [*inner, *others])
    if others and not hint.endswith("?"):
        hint += f"; the job takes {', '.join(others)}, too"
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
    """Images are reduced for detection until their longer side has at most this many pixels."""
    contrast_threshold: float = 0.02
    """SIFT: blobs with less contrast are ignored (in the unit of OpenCV's contrastThreshold)."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_options(self, infinite=("max_error_px", "max_distance"))
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
    """SIFT: the largest third of both images' features, at most this many, are matched first (preemptive
    matching); the others then along their epipolar lines. 0: all features are matched with all."""
    preemptive_min_matches: int = 12
    """With fewer preemptive matches the images count as not overlapping."""
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
        check_options(self, infinite=("max_error_px", "max_distance"))
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
    """Times that the image is halved, and one more."""
    max_return_px: float = 0.7
    """A point followed there and back again ends at most so far from where it began."""
    min_eigenvalue: float = 1e-4
    """Of the patch's gradient matrix per pixel (in units of OpenCV's minEigThreshold): flatter patches are lost."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_options(self, infinite=("max_error_px", "max_distance"))
        if self.window_px < 5 or self.window_px % 2 == 0 or not 1 <= self.levels <= 8:
            raise ConfigError("window_px must be odd and at least 5, levels from 1 to 8")
        if not 0 < self.max_return_px < 1e3 or not 0 <= self.min_eigenvalue < 1e3:
            raise ConfigError("max_return_px must be positive and min_eigenvalue not negative")


MIN_ON_LINES, MIN_BEYOND_SAMPLE = 15, 4


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
    min_inliers: int | None = None
    """Fewer inliers count as failure. None: as many as chance hardly gives, see `needed_inliers`."""
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
        check_options(self, infinite=("max_error_px", "max_distance"))
        if not self.max_error_px > 0:
            raise ConfigError(f"max_error_px must be positive, got {self.max_error_px}")
        if _LARGEST < self.max_error_px < math.inf:
            raise ConfigError(f"max_error_px is too large to be calculated with: {self.max_error_px:g}")
        if not 0 < self.confidence < 1:
            raise ConfigError(f"confidence must be between 0 and 1, got {self.confidence}")
        if not 0 <= self.min_inlier_ratio <= 1:
            raise ConfigError(f"min_inlier_ratio must be between 0 and 1, got {self.min_inlier_ratio}")
        if min(self.min_iterations, self.max_iterations, self.needed_inliers(1, 1)) < 1:
            raise ConfigError("min_iterations, max_iterations and min_inliers must be at least 1")
        if self.seed < 0:
            raise ConfigError(f"seed must not be negative, got {self.seed}")

    def needed_inliers(self, sample_size: int, residual_size: int) -> int:
        """Inliers without which an estimate fails.

        A wrong match lies within 4 px of an epipolar line once in a hundred times, and within 4 px of a point once in ten
        thousand. By default a model that predicts lines needs 15, one that predicts points its sample and 4 more.

        Args:
            sample_size: items that determine the model.
            residual_size: numbers that an item's residual has: 1 for a distance from a line.
        """
        if self.min_inliers is not None:
            return self.min_inliers
        return MIN_ON_LINES if residual_size == 1 else sample_size + MIN_BEYOND_SAMPLE


def check_dictionary(name: str) -> None:
    """Check that there is a dictionary of markers of this name.

    Raises:
        ConfigError: there is none.
    """
    side, _, count = name.partition("_")
    is_sized = side in ("4X4", "5X5", "6X6", "7X7") and count in ("50", "100", "250", "1000")
    if name not in _DICTIONARIES and not is_sized:
        raise ConfigError(
            f"unknown dictionary {name!r}: 4X4_50 to 7X7_1000, or one of {', '.join(_DICTIONARIES)}"
        )


@dataclass(frozen=True, kw_only=True)
class BoardConfig:
    """What the calibration board looks like."""

    kind: Literal["chessboard", "charuco", "apriltag"] = "chessboard"
    columns: int = 9
    """Inner corners in a row of a chessboard; squares of a ChArUco board; tags of an AprilTag grid."""
    rows: int = 6
    """The same in a column."""
    square: float = 1.0
    """Side of a square (or tag); its unit is that of the translations and depths. 1: they are in squares."""
    marker_ratio: float = 0.75
    """ChArUco: side of a marker divided by that of a square."""
    spacing: float = 0.3
    """AprilTag grid: gap between tags divided by the side of a tag (Kalibr's tagSpacing)."""
    dictionary: str = ""
    """Dictionary of the markers, OpenCV's name without DICT_; empty: 4X4_50 for ChArUco, APRILTAG_36h11 for
    AprilTags."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_options(self, infinite=("max_error_px", "max_distance"))
        least = 1 if self.kind == "apriltag" else 3
        if min(self.columns, self.rows) < least:
            raise ConfigError(
                f"a {self.kind} needs at least {least} columns and rows, got {self.columns} x {self.rows}"
            )
        if not 0 < self.square < float("inf"):
            raise ConfigError(f"square must be positive and finite, got {self.square}")
        if not (0 < self.marker_ratio < 1 and self.spacing >= 0):
            raise ConfigError("marker_ratio must lie between 0 and 1, spacing must not be negative")
        if self.dictionary:
            check_dictionary(self.dictionary)

    @property
    def dictionary_name(self) -> str:
        """The dictionary, or the default of the kind of board."""
        return self.dictionary or ("APRILTAG_36h11" if self.kind == "apriltag" else "4X4_50")


ANCHOR_FILES = ("positions", "lengths", "odometry", "odometry_mounting", "imu", "imu_mounting")
"""Options of `AnchorOptions` that name files."""


@dataclass(frozen=True, kw_only=True)
class AnchorOptions:
    """What is known besides the images and fixes the scale: places, lengths, objects of known size, odometry, an IMU."""

    positions: Path | None = None
    """Measured places of the camera, which fix the scale and the world: `SECONDS X Y Z` a line by the frames' clock (GPS
    in local metres, or any log), or `PICTURE X Y Z`."""
    positions_sigma_m: float = 1.0
    """Standard deviation of a coordinate of these."""
    lengths: Path | None = None
    """Known lengths, a line for each end in each image: `NAME METRES END PICTURE X Y`. END is a or b; (0, 0) is the centre
    of the first pixel of the image as it is looked at."""
    lengths_sigma_m: float = 0.002
    """Standard deviation of a length."""
    clicks_sigma_px: float = 1.0
    """Standard deviation of a pixel's coordinate in that file."""
    tag_size_m: float | None = None
    """Side of the black squares of AprilTags or ArUco markers in the scene."""
    tag_family: str = "36h11"
    """AprilTags: 16h5, 25h9, 36h10 or 36h11; ArUco: 4X4_50 to 7X7_1000, or ARUCO_ORIGINAL."""
    board: str | None = None
    """A chessboard in the scene: inner corners in a row and in a column, such as 9x6."""
    square_m: float | None = None
    """Side of its squares."""
    size_sigma: float = 0.003
    """Standard deviation of the stated size of tags and squares, as a share of it; all of them err alike."""
    odometry: Path | None = None
    """How far the camera went: `SECONDS METRES` a line, counted from any begin, or a trajectory (TUM's form)."""
    odometry_sigma: float = 0.01
    """Standard deviation of the wheels' unit, as a share; their slip is seen in the scatter."""
    odometry_mounting: Path | None = None
    """Where the point is that odometry tells of, such as the middle of the wheels: a file like that of `imu_mounting`. Without it
    that point is taken to be the camera."""
    imu: Path | None = None
    """What an inertial unit measured: EuRoC's imu0 folder, `SECONDS wx wy wz ax ay az` a line, or a recording of ROS."""
    imu_mounting: Path | None = None
    """How it is mounted: EuRoC's sensor.yaml of the camera (T_BS), or Kalibr's file with T_cam_imu."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense, or lacks another.
        """
        check_options(self, infinite=("max_error_px", "max_distance"))
        for name in ("positions_sigma_m", "lengths_sigma_m", "clicks_sigma_px", "tag_size_m", "square_m"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ConfigError(f"{name} must be positive and finite, got {value}")
        for name in ("size_sigma", "odometry_sigma"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigError(f"{name} is a share, from 0 to below 1, got {getattr(self, name)}")
        if (self.board is None) != (self.square_m is None):
            raise ConfigError("a board of known size needs both: board (such as 9x6) and square_m")
        if (self.imu is None) != (self.imu_mounting is None):
            raise ConfigError("an IMU tells the scale where its mounting is known: give imu and imu_mounting")
        if self.odometry_mounting is not None and self.odometry is None:
            raise ConfigError("odometry_mounting says which point odometry tells of: give odometry, too")
        check_dictionary(self.dictionary_name)
        self.board_config()

    @property
    def is_empty(self) -> bool:
        """Nothing is known besides the images."""
        return not self.given

    @property
    def given(self) -> tuple[str, ...]:
        """Names of the options that say what is known."""
        names = ("positions", "lengths", "tag_size_m", "board", "odometry", "imu")
        return tuple(name for name in names if getattr(self, name) is not None)

    @property
    def dictionary_name(self) -> str:
        """The tags' dictionary by OpenCV's name, without DICT_."""
        april = f"APRILTAG_{self.tag_family.lower()}"
        return april if april in _DICTIONARIES else self.tag_family.upper()

    def board_config(self) -> BoardConfig | None:
        """The board as the detector takes it; None where none is given.

        Raises:
            ConfigError: it is not two numbers.
        """
        if self.board is None or self.square_m is None:
            return None
        columns, _, rows = self.board.lower().partition("x")
        if not (columns.isdecimal() and rows.isdecimal()):
            raise ConfigError(
                f"board is inner corners in a row and in a column, such as 9x6, got {self.board!r}"
            )
        return BoardConfig(columns=int(columns), rows=int(rows), square=self.square_m)
