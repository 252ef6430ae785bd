"""Every option of the system, defined once; the command line is generated from these classes.

They stand in one light module, because rooms import compiled kernels and `epipole --help` must not wait for them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

from epipole.errors import ConfigError

Options = TypeVar("Options")


def options_of(kind: type[Options], given: Options | None) -> Options:
    """What was given, or the defaults for None.

    Raises:
        ConfigError: something else was given, a dict for one.
    """
    if given is None:
        return kind()
    if not isinstance(given, kind):
        hint = f"; {kind.__name__}(**it) makes one" if isinstance(given, dict) else ""
        raise ConfigError(f"options must be a {kind.__name__}, not a {type(given).__name__}{hint}")
    return given


@dataclass(frozen=True, kw_only=True)
class FeatureConfig:
    """Options of feature detection."""

    kind: Literal["sift", "orb"] = "sift"
    """SIFT, or ORB where speed matters more than reach."""
    max_features: int = 8192
    """Features kept per image, the largest first."""
    max_size_px: int = 3200
    """Larger pictures are reduced to this longer side for detection."""
    contrast_threshold: float = 0.02
    """SIFT: fainter blobs are ignored (OpenCV's unit)."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        if self.max_features < 1 or self.max_size_px < 16:
            raise ConfigError("max_features must be at least 1 and max_size_px at least 16")


@dataclass(frozen=True, kw_only=True)
class MatchConfig:
    """Options of matching."""

    max_ratio: float = 0.8
    """Lowe's ratio: the nearest descriptor must be nearer than this times the second nearest."""
    max_distance: float = 0.7
    """SIFT: largest angle between matching descriptors, in radians."""
    max_bits: int = 64
    """ORB: largest Hamming distance of a match."""
    scout_features: int = 2048
    """SIFT: of both pictures so many features at most, the largest third, are compared first; their geometry
    guides the rest. 0: never."""
    scout_min_matches: int = 12
    """Fewer matches of the scouts mean that the pictures do not overlap."""
    scout_min_inliers: int = 30
    """Fewer consistent scouts guide nobody: all features are compared with all."""
    band_px: float = 3.0
    """Guided matches lie within so many pixels of their epipolar line."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        if not 0 < self.max_ratio <= 1:
            raise ConfigError(f"max_ratio must be in (0, 1], got {self.max_ratio}")
        if self.scout_features < 0 or not self.band_px > 0:
            raise ConfigError("scout_features must not be negative and band_px must be positive")


@dataclass(frozen=True, kw_only=True)
class PairingConfig:
    """Options of choosing the pairs of images that are matched."""

    method: Literal["auto", "exhaustive", "sequential", "spatial", "retrieval"] = "auto"
    """auto: sequential for video; exhaustive up to a limit; beyond it spatial with GPS, else retrieval."""
    exhaustive_limit: int = 120
    """auto: up to so many images, all pairs."""
    neighbours: int = 30
    """retrieval and spatial: pairs per image."""
    overlap: int = 10
    """sequential: each image with so many that follow, and with its retrieved look-alikes."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        if min(self.neighbours, self.overlap, self.exhaustive_limit) < 1:
            raise ConfigError("neighbours, overlap and exhaustive_limit must be at least 1")


@dataclass(frozen=True, kw_only=True)
class RansacConfig:
    """Options of the robust loop."""

    max_error_px: float = 4.0
    """Matches with a larger residual are outliers."""
    confidence: float = 0.9999
    """Probability of having drawn a sample of inliers before stopping."""
    min_iterations: int = 50
    max_iterations: int = 10_000
    min_inliers: int = 15
    """Fewer inliers count as failure."""
    min_inlier_ratio: float = 0.0
    """A smaller share of inliers is not searched for, though taken when met: saves time where it would be a failure."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        if not self.max_error_px > 0:
            raise ConfigError(f"max_error_px must be positive, got {self.max_error_px}")
        if not 0 < self.confidence < 1:
            raise ConfigError(f"confidence must be between 0 and 1, got {self.confidence}")
        if not 0 <= self.min_inlier_ratio <= 1:
            raise ConfigError(f"min_inlier_ratio must be between 0 and 1, got {self.min_inlier_ratio}")
        if min(self.min_iterations, self.max_iterations, self.min_inliers) < 1:
            raise ConfigError("min_iterations, max_iterations and min_inliers must be at least 1")


@dataclass(frozen=True, kw_only=True)
class MapperConfig:
    """Options of incremental mapping."""

    start_min_inliers: int = 100
    """Matches that the first pair must have; less is asked when no pair has them."""
    start_angle_deg: float = 16.0
    """Median triangulation angle from which on a wider one does not make a better first pair."""
    start_trials: int = 30
    """First pairs tried at most."""
    probe_images: int = 5
    """A start is judged when its model has so many images."""
    sound_share: float = 0.75
    """Share of the matches between registered images that a sound model sees as common points."""
    sound_end_share: float = 0.6
    """The same for a finished model; below it other starts are tried."""
    restarts: int = 3
    """Other starts tried at most."""
    image_share: float = 0.3
    """An image whose matches agree less with the model is taken out again."""
    max_error_px: float = 4.0
    """Observations with a larger reprojection error are dropped."""
    min_angle_deg: float = 1.5
    """Points seen under a narrower angle are dropped: their depth is not known."""
    resection_max_error_px: float = 12.0
    resection_min_inliers: int = 30
    resection_min_ratio: float = 0.15
    """Share of the points in sight that must agree with an image's place."""
    min_observations: int = 15
    """An image left with fewer is taken out again."""
    local_images: int = 6
    """Images adjusted together after each new one."""
    global_growth: float = 1.25
    """The whole model is adjusted each time it has grown by this factor."""
    final_rounds: int = 5
    """Adjust, filter and triangulate again at most so often in the end."""
    settled_share: float = 5e-4
    """Share of changed observations below which the model counts as settled."""
    final_loss: Literal["trivial", "huber", "soft_l1", "cauchy"] = "cauchy"
    """Robust loss of the last adjustment; soft L1 before it."""
    loss_scale_px: float = 1.0
    """Residuals beyond this count less while the model grows."""
    final_scale_px: float = 0.5
    """The same in the last adjustment."""
    refine_focal: bool = True
    """Refine focal lengths that are not given as known."""
    refine_distortion: bool = True
    """Refine distortion that is not given as known."""
    max_models: int = 10
    """Components mapped at most when the pictures do not connect."""
    gps_sigma_m: float = 3.0
    """Standard deviation of GPS places; they take part in the adjustment with Cauchy's loss."""
    use_gps: bool = True
    """Use GPS of the EXIF as a robust prior and for the scale."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        if not self.max_error_px > 0 or not self.resection_max_error_px > 0 or not self.gps_sigma_m > 0:
            raise ConfigError("error bounds must be positive")
        if not self.global_growth > 1:
            raise ConfigError("global_growth must be greater than 1")


@dataclass(frozen=True, kw_only=True)
class ReconstructConfig:
    """Options of `epipole reconstruct`. A new user needs none."""

    camera_model: str | None = None
    """PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV or OPENCV_FISHEYE (SIMPLE_RADIAL unless parameters are given)."""
    camera_params: str | None = None
    """Known intrinsics, comma separated, in COLMAP's order and pixel convention: one camera took all pictures."""
    refine_known: bool = False
    """Refine known intrinsics too."""
    single_camera: bool = False
    """One camera took all pictures."""
    masks: Path | None = None
    """Folder of masks: MASKS/NAME.png; features where the mask is black are dropped."""
    pairs: Path | None = None
    """Text file of image pairs to match, two names a line."""
    database: Path | None = None
    """COLMAP database whose features and matches are used in place of own ones (its cameras too, unless given)."""
    max_frames: int = 200
    """Frames taken from a video."""
    executor: Literal["threads", "processes", "inline"] = "threads"
    """Who does the units of work."""
    threads: int | None = None
    """Number of threads; results do not depend on it. None: every processor."""
    features: FeatureConfig = field(default_factory=FeatureConfig)
    matching: MatchConfig = field(default_factory=MatchConfig)
    pairing: PairingConfig = field(default_factory=PairingConfig)
    verification: RansacConfig = field(default_factory=lambda: RansacConfig(min_inlier_ratio=0.3))
    mapper: MapperConfig = field(default_factory=MapperConfig)

    def __post_init__(self) -> None:
        """Check what can be checked without looking at the pictures.

        Raises:
            ConfigError: camera parameters are not numbers, or threads is not positive.
        """
        self.known_params()
        if self.max_frames < 2:
            raise ConfigError(f"max_frames must be at least 2, got {self.max_frames}")
        if self.threads is not None and self.threads < 1:
            raise ConfigError(f"threads must be at least 1, got {self.threads}")

    def known_params(self) -> tuple[float, ...] | None:
        """The numbers of `camera_params`; None when not given.

        Raises:
            ConfigError: not numbers.
        """
        if self.camera_params is None:
            return None
        try:
            return tuple(float(p) for p in self.camera_params.replace(",", " ").split())
        except ValueError:
            raise ConfigError(
                f"camera_params must be numbers separated by commas, got {self.camera_params!r}"
            ) from None


@dataclass(frozen=True, kw_only=True)
class StereoConfig:
    """Options of dense stereo matching."""

    min_disparity_px: int = 0
    """Smallest disparity looked for; 0: where the rig says that the principal points differ, that of infinity."""
    max_disparity_px: int | None = None
    """Largest disparity looked for; None: found from the pictures."""
    search: Literal["full", "coarse_to_fine"] = "full"
    """Try every disparity everywhere; or, in each tile of the picture, those about what a picture of half the size shows there."""
    method: Literal["sgm", "block"] = "sgm"
    """Semi-global matching along paths; or sums over blocks: nothing assumed smooth, more mistakes where there is little texture."""
    block_px: int = 9
    """Side of the blocks, odd, at most 15."""
    paths: Literal[4, 8] = 8
    """Along how many directions costs are summed; four take a fifth less time."""
    window: tuple[int, int] = (5, 5)
    """Width and height of the census window, odd."""
    brightness_cost: int = 0
    """Up to so many bits are added for a difference of brightness, one for every two grey levels: for pairs of equal exposure."""
    small_penalty: int = 20
    """P1: for a change of disparity by one between neighbours, in bits of the census."""
    edge_penalty: float = 6.0
    """A larger change costs P1 (1 + edge_penalty exp(-difference of brightness / edge_fade))."""
    edge_fade: float = 10.0
    left_right: Literal["accurate", "fast"] = "accurate"
    """Check against the other picture's own disparities, or (half the time) against those read off the same sums."""
    max_left_right_px: float = 1.25
    """Disparities of the two pictures that differ by more are occluded."""
    min_margin: float = 0.0
    """The second lowest sum must exceed the lowest by this share of it; else the pixel is ambiguous."""
    max_sigma_px: float | None = None
    """Disparities with a larger standard deviation are left out; None: all are kept."""
    min_region_px: int = 40
    """Smaller regions of one smooth disparity are speckles."""
    median_px: Literal[0, 3, 5] = 5
    """Side of the median filter; 0: none."""
    uncalibrated: bool = False
    """Nothing is known of the cameras, and the pair is not rectified: do it through the fundamental matrix. There is no depth."""
    fill: bool = False
    """Guess what is not known, in files of their own: filled.pfm, and filled_mask.png where it was guessed."""
    max_frames: int = 20
    """Pairs taken from stereo video."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        allowed = {
            "search": ("full", "coarse_to_fine"),
            "method": ("sgm", "block"),
            "paths": (4, 8),
            "left_right": ("accurate", "fast"),
            "median_px": (0, 3, 5),
        }
        for name, values in allowed.items():
            if getattr(self, name) not in values:
                raise ConfigError(
                    f"{name} must be one of {', '.join(map(str, values))}, got {getattr(self, name)}"
                )
        if self.max_disparity_px is not None and self.max_disparity_px < self.min_disparity_px:
            raise ConfigError(
                f"max_disparity_px ({self.max_disparity_px}) must be at least min_disparity_px ({self.min_disparity_px})"
            )
        if (
            any(side < 1 or side % 2 == 0 for side in self.window)
            or not 2 < self.window[0] * self.window[1] <= 121
        ):
            raise ConfigError(f"window must have odd sides and at most 121 pixels, is {self.window}")
        if self.block_px < 1 or self.block_px % 2 == 0 or self.block_px > 15:
            raise ConfigError(f"block_px must be odd and at most 15, is {self.block_px}")
        if self.brightness_cost < 0:
            raise ConfigError("brightness_cost must not be negative")
        bits = self.window[0] * self.window[1] - 1 + self.brightness_cost
        largest = self.small_penalty * (1.0 + self.edge_penalty)
        if self.small_penalty < 1 or self.edge_penalty < 0 or not self.edge_fade > 0 or bits + largest > 254:
            raise ConfigError(
                f"the cost's {bits} bits and the largest penalty {largest:g} must not exceed 254 together, and be positive"
            )
        if self.search == "coarse_to_fine" and self.left_right == "fast":
            raise ConfigError(
                "coarse_to_fine needs the accurate left-right check: tiles do not show the other picture's side"
            )
        if self.max_sigma_px is not None and not self.max_sigma_px > 0:
            raise ConfigError(f"max_sigma_px must be positive, is {self.max_sigma_px}")
        if not self.max_left_right_px > 0 or not self.min_margin >= 0 or self.min_region_px < 0:
            raise ConfigError("max_left_right_px must be positive, min_margin and min_region_px not negative")


@dataclass(frozen=True, kw_only=True)
class CalibrationOptions:
    """Where a calibration is read from."""

    calibration: tuple[Path, ...] = ()
    """File of both cameras, of epipole, OpenCV, Kalibr, KITTI or Middlebury; or two files (ROS' or EuRoC's left and right,
    OpenCV's intrinsics and extrinsics). The pair is rectified by it."""
    cameras: tuple[int, int] | None = None
    """Left and right camera of a calibration that has more than two, counted from 0."""


@dataclass(frozen=True, kw_only=True)
class RigOptions:
    """What is known of a rectified pair of cameras; with focal length and baseline there is depth."""

    focal_px: float | None = None
    """Focal length of both rectified cameras."""
    baseline: float | None = None
    """Distance between the cameras, in the unit the depth is wanted in."""
    principal_point: tuple[float, float] | None = None
    """Of the left camera, x y; None: the middle of the picture."""
    principal_offset_px: float = 0.0
    """Principal point of the right camera minus that of the left, along x."""
    focal_sigma_px: float = 0.0
    """Standard deviation of the focal length; the three enter that of the depth."""
    baseline_sigma: float = 0.0
    principal_offset_sigma_px: float = 0.0


_DICTIONARIES = ("APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11", "ARUCO_ORIGINAL")


@dataclass(frozen=True, kw_only=True)
class BoardConfig:
    """What the calibration board looks like."""

    kind: Literal["chessboard", "charuco", "apriltag"] = "chessboard"
    columns: int = 9
    """Inner corners in a row of a chessboard; squares of a ChArUco board; tags of an AprilTag grid."""
    rows: int = 6
    square: float = 1.0
    """Side of a square (of a tag), in the unit that translations and depths are wanted in; 1: in squares."""
    marker_share: float = 0.75
    """Side of a ChArUco marker over that of a square."""
    spacing: float = 0.3
    """Gap between AprilTags over the side of a tag."""
    dictionary: str = ""
    """Of the markers, in OpenCV's words without DICT_; empty: 4X4_50 for ChArUco, APRILTAG_36h11 for AprilTags."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        least = 1 if self.kind == "apriltag" else 3
        if min(self.columns, self.rows) < least:
            raise ConfigError(
                f"a {self.kind} needs at least {least} columns and rows, got {self.columns} x {self.rows}"
            )
        if not 0 < self.square < float("inf"):
            raise ConfigError(f"square must be positive and finite, got {self.square}")
        if not (0 < self.marker_share < 1 and self.spacing >= 0):
            raise ConfigError("marker_share must lie between 0 and 1, spacing must not be negative")
        name = self.dictionary
        sizes = name.split("_")[0] in ("4X4", "5X5", "6X6", "7X7") and name.split("_")[-1] in (
            "50",
            "100",
            "250",
            "1000",
        )
        if name and name not in _DICTIONARIES and not sizes:
            raise ConfigError(
                f"unknown dictionary {name!r}: 4X4_50 to 7X7_1000, or one of {', '.join(_DICTIONARIES)}"
            )

    @property
    def dictionary_name(self) -> str:
        """The dictionary, with the kind's own where none is given."""
        return self.dictionary or ("APRILTAG_36h11" if self.kind == "apriltag" else "4X4_50")


@dataclass(frozen=True, kw_only=True)
class CalibrationConfig:
    """Options of `epipole calibrate`."""

    board: BoardConfig = field(default_factory=BoardConfig)
    model: Literal["PINHOLE", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"] = "OPENCV"
    """OPENCV: two focal lengths, k1, k2, p1, p2; FULL_OPENCV: k3 too (k4 to k6 stay zero); OPENCV_FISHEYE: k1 to k4 of the angle."""
    refine_warp: bool = False
    """Estimate how the board bends, two numbers; needs views from many sides."""
    outlier_factor: float = 5.0
    """Corners farther off than so many robust standard deviations are left out."""
    max_view_factor: float = 4.0
    """Views whose residuals are so many times the median view's are left out."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        if not (self.outlier_factor > 1 and self.max_view_factor > 1):
            raise ConfigError("outlier_factor and max_view_factor must be greater than 1")
