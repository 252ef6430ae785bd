"""The similarity from the model to meters east, north and up, from which the adjustment starts.

Three control points that are not on a line determine it; otherwise GPS does. Gross errors are found here: control points
far from the GPS positions, exchanged axes, and heights above different surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from epipole.config import RansacConfig
from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.geometry import Similarity3, align_points
from epipole.geometry.geodesy import ecef_from_lat_lon_alt
from epipole.pipelines.georeferencing.heights import SURFACES, mixed_heights
from epipole.pipelines.georeferencing.survey import GpsFixes, SurveyedPoints
from epipole.pipelines.sfm.gps.alignment import align_to_gps
from epipole.pipelines.sfm.mapping_stage import GPS_OUTLIER_SIGMAS, VAGUE_UP_RAD
from epipole.pipelines.sfm.up_direction import up_directions
from epipole.robust import estimate_similarity
from epipole.scene import Reconstruction

MIN_CONTROL = 3
MIN_WIDTH = 0.02
"""Width of the control points across their longest direction, relative to their length, below which they are on a line."""
TOLERANCE = 0.01
"""Distance of an inlier, relative to the extent of the control points: models are bent before they are adjusted."""
FAR_M = 20_000.0
"""Distance between control points and GPS positions beyond which they are not of the same area."""
DIFFERENT_M = 30.0
"""Horizontal offset above which a warning is given: the coordinate systems may differ."""
HEIGHT_OFFSET_M = 12.0
"""Vertical offset above which a warning is given; the geoid is up to 107 m from the ellipsoid, GPS altitudes are meters off."""
OFFSET_SIGMAS, LEAST_OFFSET_M = 10.0, 1.0
"""Offsets above this many standard deviations of a precise receiver, and above this length, give the same warnings."""
STEEP = 0.5
"""Mean upward component of the viewing directions above which cameras look up."""
EXCHANGED = "the first two columns of the control points are exchanged: easting (longitude) must come first, then northing (latitude)"
MUCH_BETTER = 0.3
"""Ratio of the residuals, with axes exchanged and as given, below which the axes are exchanged."""


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where the adjustment starts."""

    enu_from_world: Similarity3
    gps: GpsFixes | None
    """The GPS positions, without their constant offset from the control points if these determine the model."""
    gps_offset_m: np.ndarray | None
    """The offset of GPS from the control points; None if either is missing."""
    warnings: tuple[str, ...]


def find_start(
    model: Reconstruction,
    surveyed: SurveyedPoints,
    triangulated: np.ndarray,
    gps: GpsFixes | None,
    gps_sigma_m: float,
    seed: int = 0,
) -> Start:
    """Align the model with control points or GPS.

    Args:
        model: the model.
        surveyed: control points and check points.
        triangulated: (n, 3) the points in the model's coordinates; NaN if unknown.
        gps: GPS positions of the images.
        gps_sigma_m: usual standard deviation of a GPS position.
        seed: random seed.

    Raises:
        ConfigError: neither control points nor GPS determine the similarity, or they contradict the images grossly.
    """
    rows = np.flatnonzero(
        surveyed.is_control
        & np.isfinite(surveyed.position_m).all(axis=1)
        & np.isfinite(triangulated).all(axis=1)
    )
    source, target = triangulated[rows], surveyed.position_m[rows]
    if not is_wide(target) or not is_wide(source):
        if gps is None:
            raise ConfigError(_too_few(len(rows)))
        return _start_with_gps(model, gps, gps_sigma_m, source, target, seed)
    enu_from_world = fit_similarity(source, target, seed)
    _refuse_exchanged_axes(model, source, target, surveyed.exchanged_m[rows], enu_from_world, seed)
    if enu_from_world is None:
        raise ConfigError(_misfit([surveyed.name[row] for row in rows], source, target))
    offset_m = None if gps is None else gps_offset(model, enu_from_world, gps)
    if offset_m is None or gps is None:
        return Start(enu_from_world, gps, None, ())
    shift = np.nan_to_num(-offset_m)
    return Start(enu_from_world, gps.shifted(shift), offset_m, tuple(_offset_warnings(offset_m, gps)))


def _start_with_gps(
    model: Reconstruction, gps: GpsFixes, sigma_m: float, source: np.ndarray, target: np.ndarray, seed: int
) -> Start:
    """Start from GPS, without its constant offset from the control points if there are one or two."""
    enu_from_world, warnings = _start_of_gps(model, gps, sigma_m, len(source), seed)
    if not len(source):
        return Start(enu_from_world, gps, None, tuple(warnings))
    shift_m = (target - enu_from_world.apply(source)).mean(axis=0)
    moved = Similarity3(enu_from_world.scale, enu_from_world.rotation, enu_from_world.translation + shift_m)
    return Start(moved, gps.shifted(shift_m), -shift_m, (*warnings, *_offset_warnings(-shift_m, gps)))


def is_wide(points: np.ndarray) -> bool:
    """Whether there are at least three points that are not on a line."""
    if len(points) < MIN_CONTROL:
        return False
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(values[1] > MIN_WIDTH * values[0])


def fit_similarity(source: np.ndarray, target: np.ndarray, seed: int = 0) -> Similarity3 | None:
    """The similarity that most points agree with; None if no more agree than any three do."""
    extent = float(np.linalg.norm(np.ptp(target, axis=0)))
    if len(source) == MIN_CONTROL:
        try:
            fitted = align_points(source, target)
        except DegenerateGeometryError:
            return None
        off = np.linalg.norm(fitted.apply(source) - target, axis=1)
        return fitted if off.max() <= TOLERANCE * extent else None
    config = RansacConfig(
        max_error_px=TOLERANCE * extent, min_inliers=MIN_CONTROL, min_inlier_ratio=0.0, seed=seed
    )
    found = estimate_similarity(source, target, config)
    return found.model if found.success and found.num_inliers > MIN_CONTROL else None


def gps_offset(model: Reconstruction, enu_from_world: Similarity3, gps: GpsFixes) -> np.ndarray | None:
    """(3,) median of GPS minus camera position; None with fewer than three positions, NaN up without altitudes."""
    off = gps.position_m - enu_from_world.apply(model.camera_centers_in_world())
    known = off[np.isfinite(off[:, :2]).all(axis=1)]
    if len(known) < MIN_CONTROL:
        return None
    up = known[np.isfinite(known[:, 2]), 2]
    return np.array([*np.median(known[:, :2], axis=0), np.median(up) if len(up) else np.nan])


def _start_of_gps(
    model: Reconstruction, gps: GpsFixes, sigma_m: float, num_control: int, seed: int
) -> tuple[Similarity3, list[str]]:
    """Similarity from GPS, and a warning if the up direction is assumed.

    Raises:
        ConfigError: GPS does not fit the model.
    """
    registered = model.is_registered()
    ups = up_directions(model.cams_from_world()[np.flatnonzero(registered)])
    centers = model.camera_centers_in_world()
    found = align_to_gps(centers, ups, gps.position_m, sigma_m, GPS_OUTLIER_SIGMAS * sigma_m, seed)
    if found is None:
        raise ConfigError(
            f"{_too_few(num_control)}; the GPS positions of the images do not fit the model either"
        )
    warnings = []
    if found.up_sigma_rad > VAGUE_UP_RAD:
        warnings.append(
            "the GPS positions lie nearly on a line and do not determine the up direction, which is assumed from the orientation of the cameras"
        )
    return found.enu_from_world, warnings


def _too_few(num_control: int) -> str:
    have = "no control point is" if num_control == 0 else f"{num_control} control points are"
    return (
        f"{have} visible in two images or more with a known position: position, orientation and scale need at least "
        f"{MIN_CONTROL} that are not on a line, or GPS"
    )


def _refuse_exchanged_axes(
    model: Reconstruction,
    source: np.ndarray,
    target: np.ndarray,
    exchanged: np.ndarray,
    as_given: Similarity3 | None,
    seed: int,
) -> None:
    """Refuse east and north exchanged: a mirror image, which fits much worse, or puts a flight below the ground.

    Raises:
        ConfigError: they are exchanged.
    """
    other = fit_similarity(source, exchanged, seed)
    if other is None:
        return
    if as_given is not None:
        before, after = _residual(as_given, source, target), _residual(other, source, exchanged)
        upward, otherwise = _upward(model, as_given), _upward(model, other)
        if otherwise > STEEP > upward:  # exchanged axes would put the cameras below what they see
            return
        looks_up = upward > STEEP and otherwise < -STEEP
        extent = float(np.linalg.norm(np.ptp(target, axis=0)))
        fits_better = before > 0.1 * TOLERANCE * extent and after < MUCH_BETTER * before
        if not (fits_better or looks_up):
            return
    raise ConfigError(EXCHANGED)


def _residual(fitted: Similarity3, source: np.ndarray, target: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(fitted.apply(source) - target, axis=1)))


def _upward(model: Reconstruction, enu_from_world: Similarity3) -> float:
    """Mean upward component of the viewing directions."""
    axes = model.cams_from_world().rotation[model.is_registered()][:, 2]
    return float((axes @ enu_from_world.rotation.T)[:, 2].mean())


def refuse_other_area(
    control_lat_lon_alt: np.ndarray, exchanged_lat_lon_alt: np.ndarray, gps_lat_lon_alt: np.ndarray
) -> None:
    """Refuse control points far from the images.

    Args:
        control_lat_lon_alt: (n, 3) degrees, degrees, meters.
        exchanged_lat_lon_alt: (n, 3) the same, with the first two columns of their file exchanged; NaN if impossible.
        gps_lat_lon_alt: (m, 3) of the images, from GPS; or that of the origin of a georeferenced model.

    Raises:
        ConfigError: they are elsewhere; the message says so if exchanged columns explain it.
    """
    here = _middle(gps_lat_lon_alt)
    distance_m = float(np.linalg.norm(_middle(control_lat_lon_alt) - here))
    if not distance_m > FAR_M:
        return
    if float(np.linalg.norm(_middle(exchanged_lat_lon_alt) - here)) < FAR_M:
        raise ConfigError(EXCHANGED)
    raise ConfigError(
        f"the control points are {distance_m / 1000.0:,.0f} km from the images, according to GPS or an earlier georeference: check the coordinate system "
        "in the first line of their file (zone, hemisphere, order of the axes)"
    )


def _middle(lat_lon_alt: np.ndarray) -> np.ndarray:
    """Earth-centered median position; NaN if none is known."""
    known = lat_lon_alt[np.isfinite(lat_lon_alt[:, :2]).all(axis=1)]
    if not len(known):
        return np.full(3, np.nan)
    return np.asarray(np.median(ecef_from_lat_lon_alt(known * [1.0, 1.0, 0.0]), axis=0))


def _misfit(names: list[str], source: np.ndarray, target: np.ndarray) -> str:
    """Why control points do not fit the model: heights above different surfaces, or something else."""
    extent = float(np.linalg.norm(np.ptp(target, axis=0)))
    mixed = mixed_heights(source, target, TOLERANCE * extent)
    if mixed is not None:
        higher, constant_m = mixed
        named = ", ".join(name for name, own in zip(names, higher) if own)
        return (
            f"the control points fit the model horizontally, but {named} {'are' if higher.sum() > 1 else 'is'} "
            f"{abs(constant_m):.1f} m {'higher' if constant_m > 0 else 'lower'} than the others put them: {SURFACES}"
        )
    return (
        f"the {len(names)} control points do not fit the model: no three of them agree with another on its scale and shape; "
        "check their coordinates and observations"
    )


def _offset_warnings(offset_m: np.ndarray, gps: GpsFixes) -> list[str]:
    """Offsets of GPS that its standard deviations do not explain; those of RTK receivers are centimeters."""
    out = []
    sigma_m = np.median(gps.sigma_m[np.isfinite(gps.position_m[:, :2]).all(axis=1)], axis=0)
    limit_m = np.maximum(LEAST_OFFSET_M, OFFSET_SIGMAS * sigma_m)
    horizontal_m, up_m = float(np.hypot(*offset_m[:2])), float(offset_m[2])
    if horizontal_m > min(DIFFERENT_M, float(limit_m[:2].max())):
        out.append(
            f"the GPS positions are {horizontal_m:.{int(horizontal_m < 10)}f} m from the images, as located by the control points, all in one direction: "
            "the coordinate systems may differ; the control points are used"
        )
    if abs(up_m) > min(HEIGHT_OFFSET_M, float(limit_m[2])):
        out.append(
            f"the GPS altitudes are {abs(up_m):.1f} m {'above' if up_m > 0 else 'below'} the heights that the control points give the "
            "images: one is probably above the ellipsoid and the other above sea level (the geoid), or the altitudes are barometric; "
            "the heights of the control points are used"
        )
    return out
