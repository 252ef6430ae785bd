"""Scale estimates from known lengths, tags, boards, odometry and an IMU."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from epipole._checks import Declared, checked
from epipole.config import ANCHOR_FILES, AnchorOptions, BoardConfig
from epipole.errors import DegenerateGeometryError, FileFormatError
from epipole.features.boards import corners_on_board, find_board
from epipole.features.tags import find_tags
from epipole.geometry import Rigid3
from epipole.inertial import MountedImu
from epipole.io.anchor_files import KnownLength, read_anchor_positions, read_lengths, read_odometry
from epipole.io.sequences.imu_logs import read_camera_from_imu, read_imu, read_mounted_imu
from epipole.robust import triangulate_points
from epipole.scale.anchor_views import AnchorViews, joined_words
from epipole.scale.inertial_scale import fit_scale_to_imu
from epipole.scale.known_objects import ObjectFit, fit_scale_to_object
from epipole.scale.scale_agreement import ScaleEstimate
from epipole.scale.traveled_scale import fit_scale_to_distances

CORNERS_SIGMA_PX = 0.15
"""Standard deviation of a detected corner; larger residuals enlarge it."""
BOARD_SIGMA_PX = 0.1
MOST_VIEWS = 60
"""Maximum number of views per object: more add little."""


@dataclass(frozen=True, slots=True, eq=False)
class ScaleEvidence(Declared):
    """Scale estimates, and the reasons why other references give none."""

    estimates: tuple[ScaleEstimate, ...]
    refusals: tuple[str, ...]

    def __repr__(self) -> str:
        return f"ScaleEvidence({len(self.estimates)} estimates, {len(self.refusals)} refusals)"


class _Gathered:
    """Collects estimates and refusals."""

    def __init__(self) -> None:
        self.estimates: list[ScaleEstimate] = []
        self.refusals: list[str] = []

    def try_one(self, name: str, estimate: Callable[[], ScaleEstimate]) -> None:
        """Add an estimate, or the reason why there is none."""
        try:
            self.estimates.append(estimate())
        except DegenerateGeometryError as error:
            words = str(error)
            self.refusals.append(words if words.startswith(name) else f"{name}: {words}")


@checked
def check_anchor_files(options: AnchorOptions) -> None:
    """Read every given file, so that errors show before any work starts.

    Raises:
        FileFormatError: a file is missing or malformed.
    """
    readers: dict[str, Callable[[Path], object]] = {
        "positions": read_anchor_positions,
        "lengths": read_lengths,
        "odometry": read_odometry,
        "odometry_mounting": read_camera_from_imu,
        "imu": partial(read_imu, units=options.imu_units, topic=options.imu_topic),
        "imu_mounting": read_camera_from_imu,
    }
    for name in ANCHOR_FILES:
        path = getattr(options, name)
        if path is not None:
            if not path.exists():
                raise FileFormatError(path, f"it does not exist ({name})")
            readers[name](path)


@checked
def scale_evidence(
    views: AnchorViews, options: AnchorOptions, path: AnchorViews | None = None
) -> ScaleEvidence:
    """Scale estimates from lengths, tags, boards, odometry and an IMU; for positions see `fit_scale_to_positions`.

    Args:
        views: posed images in which to detect tags and boards.
        options: the scale references.
        path: all posed images, for lengths and odometry; None: the same.

    Raises:
        FileFormatError: a given file cannot be read.
    """
    found = _Gathered()
    everywhere = views if path is None else path
    if options.lengths is not None:
        for known in read_lengths(options.lengths):
            found.try_one(known.name, partial(_of_length, everywhere, known, options))
    if options.tag_size_m is not None:
        _add_tags(views, options, found)
    board = options.board_config()
    if board is not None:
        found.try_one(f"the board of {options.board}", lambda: _of_board(views, board, options))
    if options.odometry is not None:
        found.try_one("odometry", lambda: _of_odometry(everywhere, options))
    imu = mounted_imu(options)
    if imu is not None:
        found.refusals += imu.log.notes
        found.try_one("IMU", partial(_of_imu, everywhere, imu))
    return ScaleEvidence(tuple(found.estimates), tuple(found.refusals))


@checked
def mounted_imu(options: AnchorOptions) -> MountedImu | None:
    """The IMU given in the options; None without one.

    Raises:
        FileFormatError: a given file cannot be read.
    """
    if options.imu is None or options.imu_mounting is None:
        return None
    return read_mounted_imu(options.imu, options.imu_mounting, options.imu_units, options.imu_topic)


def _of_length(views: AnchorViews, known: KnownLength, options: AnchorOptions) -> ScaleEstimate:
    names = list(dict.fromkeys([*known.ends[0], *known.ends[1]]))
    rows = {name: views.row_of(name) for name in names}
    missing = [name for name in names if rows[name] is None]
    registered = [name for name in names if rows[name] is not None]
    pixels = np.array([[end.get(name, (np.nan, np.nan)) for end in known.ends] for name in registered])
    try:
        fit = _fit_object(
            np.array([[0.0, 0.0, 0.0], [known.length_m, 0.0, 0.0]]),
            views,
            [row for row in rows.values() if row is not None],
            pixels.reshape(-1, 2, 2),
            options.clicks_sigma_px,
        )
    except DegenerateGeometryError as error:
        words = (
            f" ({joined_words(missing)} {'has' if len(missing) == 1 else 'have'} no pose)" if missing else ""
        )
        raise DegenerateGeometryError(f"{error}{words}") from error
    sigma = fit.scale * float(np.hypot(fit.sigma / fit.scale, options.lengths_sigma_m / known.length_m))
    words = f"{known.length_m:g} m in {int(fit.kept_mask.sum())} images"
    return ScaleEstimate("length", f"length {known.name}", fit.scale, sigma, 0.0, words)


def _add_tags(views: AnchorViews, options: AnchorOptions, found: _Gathered) -> None:
    size = options.tag_size_m
    assert size is not None
    seen: dict[int, list[tuple[int, np.ndarray]]] = {}
    for row in range(len(views)):
        image = views.image_of(row)
        if image is not None:
            tags = find_tags(image, options.dictionary_name)
            for number, corners in zip(tags.number, tags.corners):
                seen.setdefault(int(number), []).append((row, corners))
    if not seen:
        found.refusals.append(f"no {options.tag_family} tag was detected in the {len(views)} posed images")
    square = 0.5 * size * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    for number, own in sorted(seen.items()):
        rows, corners = [row for row, _ in own], np.stack([c for _, c in own])

        def of_tag(
            number: int = number, rows: list[int] = rows, corners: np.ndarray = corners
        ) -> ScaleEstimate:
            fit = _fit_object(square, views, rows, corners, CORNERS_SIGMA_PX)
            words = f"{int(fit.kept_mask.sum())} images"
            return ScaleEstimate("tag", f"tag {number}", fit.scale, fit.sigma, options.size_sigma, words)

        found.try_one(f"tag {number}", of_tag)


def _of_board(views: AnchorViews, board: BoardConfig, options: AnchorOptions) -> ScaleEstimate:
    shape = corners_on_board(board)
    rows, pixels = [], []
    for row in range(len(views)):
        image = views.image_of(row)
        view = None if image is None else find_board(image, board)
        if view is not None and len(view) == len(shape):
            rows.append(row)
            pixels.append(view.pixels)
    if not rows:
        raise DegenerateGeometryError(f"it was detected in none of the {len(views)} posed images")
    fit = _fit_object(shape, views, rows, _in_one_order(views, rows, np.stack(pixels), board), BOARD_SIGMA_PX)
    words = f"{int(fit.kept_mask.sum())} images"
    return ScaleEstimate(
        "board", f"the board of {options.board}", fit.scale, fit.sigma, options.size_sigma, words
    )


def _in_one_order(
    views: AnchorViews, rows: Sequence[int], pixels: np.ndarray, board: BoardConfig
) -> np.ndarray:
    """Chessboard corners may start at either end: in each image, pick the order whose rays meet the first image's."""
    grid = np.arange(board.columns * board.rows).reshape(board.rows, board.columns)
    rotations = (0, 1, 2, 3) if board.columns == board.rows else (0, 2)
    orders = [np.rot90(grid, rotation).ravel() for rotation in rotations]
    out = pixels.copy()
    for v in range(1, len(rows)):
        two, cameras = (
            views.cams_from_world[np.array([rows[0], rows[v]])],
            [views.cameras[rows[0]], views.cameras[rows[v]]],
        )
        errors = []
        for order in orders:
            met = triangulate_points(two, cameras, np.stack([pixels[0], pixels[v][order]]))
            good = met.success_mask
            errors.append(float(np.median(met.errors_px[good])) if 2 * good.sum() > len(good) else np.inf)
        out[v] = pixels[v][orders[int(np.argmin(errors))]]
    return out


def _fit_object(
    shape: np.ndarray, views: AnchorViews, rows: Sequence[int], pixels: np.ndarray, sigma_px: float
) -> ObjectFit:
    if len(rows) > MOST_VIEWS:
        kept = np.linspace(0, len(rows) - 1, MOST_VIEWS).astype(int)
        rows, pixels = [rows[k] for k in kept], pixels[kept]
    at = np.array(rows, np.int64)
    covariance = np.array([views.covariance_of(row) for row in rows]).reshape(-1, 6, 6)
    return fit_scale_to_object(
        shape,
        views.cams_from_world[at],
        [views.cameras[row] for row in rows],
        pixels,
        sigma_px,
        covariance,
    )


def _of_odometry(views: AnchorViews, options: AnchorOptions) -> ScaleEstimate:
    assert options.odometry is not None
    log = read_odometry(options.odometry)
    times, path = _timed(views)
    known = (log.timestamp_s, log.traveled_m, log.positions, options.odometry_sigma)
    levers = None
    if options.odometry_mounting is not None:
        levers = path.rotation @ read_camera_from_imu(options.odometry_mounting).translation
    return fit_scale_to_distances(times, path.translation, *known, levers)


def _of_imu(views: AnchorViews, imu: MountedImu) -> ScaleEstimate:
    times, path = _timed(views)
    return fit_scale_to_imu(times, path, imu)


def _timed(views: AnchorViews) -> tuple[np.ndarray, Rigid3]:
    """Times and world_from_camera of the images that have a time, sorted by time."""
    timed = np.flatnonzero(np.isfinite(views.timestamp_s))
    if not len(timed):
        raise DegenerateGeometryError("the images have no times")
    timed = timed[np.unique(views.timestamp_s[timed], return_index=True)[1]]
    return views.timestamp_s[timed], views.cams_from_world[timed].inverse()
