"""Options shared by several parts of the package, from which the command line is generated.

The options of a pipeline are in its own `config.py`. These modules import no kernels, to keep `--help` fast.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

from epipole._checks import check_options, did_you_mean
from epipole.errors import ConfigError

Options = TypeVar("Options")
_Photogrammetry = Literal[
    "txt", "bin", "ply", "transforms", "bundler", "opensfm", "metashape", "realityscan", "kapture"
]
ModelFormat = Literal[_Photogrammetry, "chan", "usd", "splat"]
"""Formats of models and splats that `epipole convert` writes."""
_LARGEST = 1e100
_DICTIONARIES = ("APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11", "ARUCO_ORIGINAL")


def options_of(
    kind: type[Options],
    given: Options | None,
    named: Mapping[str, Any] | None = None,
    others: Sequence[str] = (),
) -> Options:
    """Options with single ones overridden by name; None: the defaults.

    A name is that of a field, or of a field of a nested config if it is unique.

    Args:
        kind: class of the options.
        given: options; None for the defaults.
        named: single options by name.
        others: further argument names of the job, suggested for unknown names.

    Raises:
        ConfigError: `given` is of another class, such as dict, a name is unknown, or a value is invalid.
    """
    if given is not None and not isinstance(given, kind):
        hint = f"; make one with {kind.__name__}(**it)" if isinstance(given, dict) else ""
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
    for holder, own in parts.items():  # at once, because their checks may depend on each other
        changes[holder] = _changed(changes.get(holder, getattr(options, holder)), own)
    return _changed(options, changes)


def _changed(options: Options, changes: Mapping[str, Any]) -> Options:
    try:
        return replace(cast(Any, options), **changes)
    except TypeError as error:  # a range check compared text with numbers
        given = ", ".join(f"{name}={value!r}" for name, value in changes.items())
        raise ConfigError(f"an option has a value of the wrong type, {given}: {error}") from error


def _holder_of(name: str, options: object, others: Sequence[str]) -> str:
    """Field whose config has a field of this name."""
    parts = {field: getattr(options, field) for field in _names(options)}
    parts = {field: part for field, part in parts.items() if is_dataclass(part)}
    fitting = [field for field, part in parts.items() if name in _names(part)]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        of = " and of ".join(fitting)
        example = f"{fitting[-1]}={type(parts[fitting[-1]]).__name__}({name}=...)"
        raise ConfigError(f"{name} is an option of {of}: specify which, as in {example}")
    inner = [each for part in parts.values() for each in _names(part)]
    hint = did_you_mean(name, _names(options), [*inner, *others])
    if others and not hint.endswith("?"):
        hint += f"; the job also takes {', '.join(others)}"
    raise ConfigError(f"{type(options).__name__} has no option {name}{hint}")


def _names(config: Any) -> list[str]:
    return [field.name for field in fields(config)]


@dataclass(frozen=True, kw_only=True)
class FeatureConfig:
    """Options of feature detection."""

    kind: Literal["sift", "orb"] = "sift"
    """SIFT, or ORB, which is faster but tolerates smaller changes of viewpoint and scale."""
    max_features: int = 8192
    """Maximum number of features per image, largest first."""
    max_size_px: int = 3200
    """Downscale images for detection to this longest side."""
    contrast_threshold: float = 0.02
    """SIFT: blobs with less contrast are ignored (OpenCV's contrastThreshold)."""
    domain_sizes: int = 1
    """SIFT: number of window sizes whose descriptors are averaged (domain-size pooling); 5 finds more matches between
    distant viewpoints, and describing takes five times as long."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        check_options(self)
        if self.max_features < 1 or self.max_size_px < 16:
            raise ConfigError("max_features must be at least 1 and max_size_px at least 16")
        if not 0 <= self.contrast_threshold < math.inf:
            raise ConfigError(
                f"contrast_threshold must be finite and not negative, got {self.contrast_threshold}"
            )
        if not 1 <= self.domain_sizes <= 16:
            raise ConfigError(f"domain_sizes must be from 1 to 16, got {self.domain_sizes}")


@dataclass(frozen=True, kw_only=True)
class MatchConfig:
    """Options of feature matching."""

    max_ratio: float = 0.8
    """Lowe's ratio: maximum distance to the nearest descriptor, relative to the second nearest."""
    max_distance: float = 0.7
    """SIFT: maximum angle between matching descriptors, in radians."""
    max_bits: int = 64
    """ORB: maximum Hamming distance of a match."""
    preemptive_features: int = 2048
    """SIFT: largest features (at most a third) that are matched first, to skip images that do not overlap; 0: match all."""
    preemptive_min_matches: int = 12
    """Images with fewer preemptive matches count as not overlapping."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        check_options(self, infinite=("max_distance",))
        if not 0 < self.max_ratio <= 1:
            raise ConfigError(f"max_ratio must be in (0, 1], got {self.max_ratio}")
        if self.preemptive_features < 0:
            raise ConfigError(f"preemptive_features must not be negative, got {self.preemptive_features}")


@dataclass(frozen=True, kw_only=True)
class FlowConfig:
    """Options of point tracking by optical flow."""

    window_px: int = 21
    """Side of the tracked patch."""
    levels: int = 4
    """Number of pyramid levels, including full resolution."""
    max_return_px: float = 0.7
    """Maximum distance between a point and its position after tracking forward and backward."""
    min_eigenvalue: float = 1e-4
    """Minimum eigenvalue of a patch's gradient matrix per pixel (OpenCV's minEigThreshold); others are lost."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        check_options(self)
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
    """Stop when an all-inlier sample has been found with this probability."""
    min_iterations: int = 50
    """Minimum number of samples."""
    max_iterations: int = 10_000
    """Maximum number of samples."""
    min_inliers: int | None = None
    """Minimum number of inliers of a valid estimate. None: more than chance gives, which grows with the number of matches."""
    min_inlier_ratio: float = 0.0
    """Stop when this fraction of inliers would have been found; smaller fractions may be missed."""
    seed: int = 0
    """Random seed."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        check_options(self, infinite=("max_error_px",))
        if not self.max_error_px > 0:
            raise ConfigError(f"max_error_px must be positive, got {self.max_error_px}")
        if _LARGEST < self.max_error_px < math.inf:
            raise ConfigError(f"max_error_px is too large: {self.max_error_px:g}")
        if not 0 < self.confidence < 1:
            raise ConfigError(f"confidence must be between 0 and 1, got {self.confidence}")
        if not 0 <= self.min_inlier_ratio <= 1:
            raise ConfigError(f"min_inlier_ratio must be between 0 and 1, got {self.min_inlier_ratio}")
        if min(self.min_iterations, self.max_iterations, self.needed_inliers(1, 1)) < 1:
            raise ConfigError("min_iterations, max_iterations and min_inliers must be at least 1")
        if self.seed < 0:
            raise ConfigError(f"seed must not be negative, got {self.seed}")

    def needed_inliers(self, sample_size: int, residual_size: int) -> int:
        """Minimum number of inliers of a valid estimate.

        A wrong match is within 4 px of an epipolar line once in a hundred times, and within 4 px of a point once in ten
        thousand. By default, a model that predicts lines needs 15 inliers, and one that predicts points its sample and
        4 more.

        Args:
            sample_size: number of items that determine the model.
            residual_size: dimension of an item's residual, such as 1 for the distance from a line.
        """
        if self.min_inliers is not None:
            return self.min_inliers
        return MIN_ON_LINES if residual_size == 1 else sample_size + MIN_BEYOND_SAMPLE


def check_dictionary(name: str) -> None:
    """Check that a dictionary of markers exists.

    Raises:
        ConfigError: it does not.
    """
    side, _, count = name.partition("_")
    is_sized = side in ("4X4", "5X5", "6X6", "7X7") and count in ("50", "100", "250", "1000")
    if name not in _DICTIONARIES and not is_sized:
        raise ConfigError(
            f"unknown dictionary {name!r}: 4X4_50 to 7X7_1000, or one of {', '.join(_DICTIONARIES)}"
        )


@dataclass(frozen=True, kw_only=True)
class BoardConfig:
    """Layout of a calibration board."""

    kind: Literal["chessboard", "charuco", "apriltag"] = "chessboard"
    """Kind of the board."""
    columns: int = 9
    """Inner corners per row of a chessboard, squares of a ChArUco board, or tags of an AprilTag grid."""
    rows: int = 6
    """The same per column."""
    square: float = 1.0
    """Side of a square or tag, in the unit of translations and depths; 1: the unit is the square."""
    marker_ratio: float = 0.75
    """ChArUco: side of a marker, relative to that of a square."""
    spacing: float = 0.3
    """AprilTag grid: gap between tags, relative to the side of a tag (Kalibr's tagSpacing)."""
    dictionary: str = ""
    """Marker dictionary, OpenCV's name without DICT_; default: 4X4_50 for ChArUco, APRILTAG_36h11 for AprilTags."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        check_options(self)
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
        """Name of the dictionary, or the default for the kind of board."""
        return self.dictionary or ("APRILTAG_36h11" if self.kind == "apriltag" else "4X4_50")


ANCHOR_FILES = ("positions", "lengths", "odometry", "odometry_mounting", "imu", "imu_mounting")
"""Options of `AnchorOptions` that name files."""


@dataclass(frozen=True, kw_only=True)
class AnchorOptions:
    """Measurements besides the images that determine the scale: positions, lengths, known objects, odometry, an IMU."""

    positions: Path | None = None
    """Measured camera positions, which fix scale and world: `SECONDS X Y Z` (video clock) or `IMAGE X Y Z` lines."""
    positions_sigma_m: float = 1.0
    """Standard deviation of their coordinates, in meters."""
    lengths: Path | None = None
    """Known lengths, a line per end (a or b) and image: `NAME METERS END IMAGE X Y`; first pixel center at (0, 0)."""
    lengths_sigma_m: float = 0.002
    """Standard deviation of a length, in meters."""
    clicks_sigma_px: float = 1.0
    """Standard deviation of the pixel coordinates in that file."""
    tag_size_m: float | None = None
    """Side of the black squares of AprilTags or ArUco markers in the scene, in meters."""
    tag_family: str = "36h11"
    """AprilTags: 16h5, 25h9, 36h10 or 36h11; ArUco: 4X4_50 to 7X7_1000, or ARUCO_ORIGINAL."""
    board: str | None = None
    """Chessboard in the scene: inner corners per row and per column, such as 9x6."""
    square_m: float | None = None
    """Side of its squares, in meters."""
    size_sigma: float = 0.003
    """Relative standard deviation of the size of tags and squares, which is common to all of them."""
    odometry: Path | None = None
    """Distance traveled, `SECONDS METERS` per line from any start, or a trajectory (TUM format)."""
    odometry_sigma: float = 0.01
    """Relative standard deviation of the odometry's unit; wheel slip is estimated from the residuals."""
    odometry_mounting: Path | None = None
    """Pose of the odometry's reference point, in a file like that of --imu-mounting; default: the camera."""
    imu: Path | None = None
    """IMU measurements: EuRoC's imu0 folder, `SECONDS wx wy wz ax ay az` per line, or a ROS recording."""
    imu_mounting: Path | None = None
    """Mounting of the IMU: EuRoC's sensor.yaml of the camera (T_BS), Kalibr's T_cam_imu, or settings of ORB-SLAM3 or OKVIS."""
    imu_units: str = ""
    """Units of the IMU: m/s^2, g or mg, and rad/s or deg/s, such as g,deg/s; empty: found by content."""
    imu_topic: str = ""
    """IMU topic of a ROS recording with several, or GYRO,ACCEL for a sensor with two; empty: the only one."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range, or requires another option.
        """
        check_options(self)
        for name in ("positions_sigma_m", "lengths_sigma_m", "clicks_sigma_px", "tag_size_m", "square_m"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ConfigError(f"{name} must be positive and finite, got {value}")
        for name in ("size_sigma", "odometry_sigma"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigError(
                    f"{name} is a fraction and must be at least 0 and below 1, got {getattr(self, name)}"
                )
        if (self.board is None) != (self.square_m is None):
            raise ConfigError("a board of known size needs both board (such as 9x6) and square_m")
        if (self.imu is None) != (self.imu_mounting is None):
            raise ConfigError("an IMU determines the scale only with its mounting: give imu and imu_mounting")
        for name in ("imu_units", "imu_topic"):
            if getattr(self, name) and self.imu is None:
                raise ConfigError(f"{name} belongs to imu: give imu, too")
        if self.odometry_mounting is not None and self.odometry is None:
            raise ConfigError("odometry_mounting belongs to odometry: give odometry, too")
        check_dictionary(self.dictionary_name)
        self.board_config()

    @property
    def is_empty(self) -> bool:
        """Whether no measurement is given."""
        return not self.given

    @property
    def given(self) -> tuple[str, ...]:
        """Names of the options with measurements that are given."""
        names = ("positions", "lengths", "tag_size_m", "board", "odometry", "imu")
        return tuple(name for name in names if getattr(self, name) is not None)

    @property
    def dictionary_name(self) -> str:
        """OpenCV's name of the tags' dictionary, without DICT_."""
        april = f"APRILTAG_{self.tag_family.lower()}"
        return april if april in _DICTIONARIES else self.tag_family.upper()

    def board_config(self) -> BoardConfig | None:
        """The board in the form that the detector needs; None if none is given.

        Raises:
            ConfigError: `board` is not two numbers.
        """
        if self.board is None or self.square_m is None:
            return None
        columns, _, rows = self.board.lower().partition("x")
        if not (columns.isdecimal() and rows.isdecimal()):
            raise ConfigError(
                f"board must be inner corners per row and per column, such as 9x6, got {self.board!r}"
            )
        return BoardConfig(columns=int(columns), rows=int(rows), square=self.square_m)
