"""What makes the map of one camera metric: places of the camera that were measured besides (GPS, a motion capture, a log)."""

from __future__ import annotations

import numpy as np

from epipole.errors import ConfigError
from epipole.geometry import Rigid3, Similarity3
from epipole.io.trajectories import PositionLog
from epipole.mapping import ScaleFit, fit_scale_to_positions
from epipole.pipelines.slam.local_mapping import LocalMapper
from epipole.pipelines.slam.slam import Slam
from epipole.scene import Trajectory

LONGEST_GAP = 3.0
"""Between measured places, in median gaps: in a longer one nothing is interpolated."""


def anchor_to_positions(system: Slam, log: PositionLog, sigma: float) -> ScaleFit:
    """Tell the first map in the log's world and metres, and adjust it with the measured places as factors.

    Args:
        system: of one camera, after its last frame.
        log: instants and places, by the frames' clock.
        sigma: standard deviation of a measured coordinate, in metres.

    Returns:
        the fit before the adjustment: the metres of the map's unit, and their deviation.

    Raises:
        ConfigError: the camera is metric already.
        DegenerateGeometryError: the places do not tell a scale; the message says why.
    """
    if system.camera.tells_depth:
        raise ConfigError(
            "positions tell the scale of one camera; this one has its metres from its own depth"
        )
    path, model = system.trajectory(), system.maps[0]
    there = _places_at(path.timestamp_s, path.world_from_body.translation, log.timestamp_s)
    known = np.isfinite(there[:, 0])
    fit = fit_scale_to_positions(there[known], log.positions[known], sigma)
    model.move(fit.world_from_model)
    mapper = LocalMapper(model, system.camera, system.focal_baseline, system.config)
    keyframes = [k for k in model.keyframes if len(k.point)]
    times = np.array([k.timestamp_s for k in keyframes])
    measured = _places_at(log.timestamp_s, log.positions, times)
    mapper.positions = {k.number: p for k, p in zip(keyframes, measured) if np.isfinite(p[0])}
    # Interpolated places repeat each other: together they weigh no more than the measured ones.
    repeats = len(mapper.positions) / max(int(known.sum()), 1)
    mapper.position_sigma = max(sigma, fit.residual_m / np.sqrt(3.0)) * float(np.sqrt(max(repeats, 1.0)))
    mapper.adjust_all()
    return fit


def _places_at(known_s: np.ndarray, places: np.ndarray, wanted_s: np.ndarray) -> np.ndarray:
    """(n, 3) places at instants, interpolated; NaN outside, and in gaps."""
    out = np.stack([np.interp(wanted_s, known_s, places[:, axis]) for axis in range(3)], axis=1)
    after = np.searchsorted(known_s, wanted_s)
    inside = (after > 0) & (after < len(known_s))
    inside |= np.isin(wanted_s, known_s)
    gap = np.diff(known_s)
    longest = LONGEST_GAP * float(np.median(gap)) if len(gap) else 0.0
    width = known_s[np.minimum(after, len(known_s) - 1)] - known_s[np.maximum(after - 1, 0)]
    return np.where((inside & (width <= longest))[:, None], out, np.nan)


def moved_path(path: Trajectory, world_from_model: Similarity3) -> Trajectory:
    """A path told in the metres and the world that were found afterwards."""
    places, scale = path.world_from_body, float(world_from_model.scale)
    moved = Rigid3(world_from_model.rotation @ places.rotation, world_from_model.apply(places.translation))
    covariance = path.covariance
    if covariance is not None:
        unit = np.array([scale, scale, scale, 1.0, 1.0, 1.0])
        covariance = covariance * unit[:, None] * unit
    return Trajectory(path.timestamp_s, moved, covariance)


def scale_words(fit: ScaleFit) -> str:
    """What fixed the scale, and how well it is known."""
    share = 100.0 * fit.sigma / float(fit.world_from_model.scale)
    return (
        f"metres, from {int(fit.kept_mask.sum())} measured places of {len(fit.kept_mask)}: "
        f"known to {share:.2g} % (1 sigma)"
    )


def scale_summary(fit: ScaleFit) -> dict[str, float]:
    """The same as numbers."""
    scale = float(fit.world_from_model.scale)
    return {
        "relative_sigma": fit.sigma / scale,
        "residual_m": fit.residual_m,
        "num_kept": int(fit.kept_mask.sum()),
    }
