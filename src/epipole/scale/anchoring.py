"""From scale references (files and options) to one similarity that makes a model metric; for SfM and SLAM."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from epipole._checks import Declared, checked
from epipole.config import AnchorOptions
from epipole.errors import DegenerateGeometryError
from epipole.geometry import Similarity3, align_points
from epipole.io.anchor_files import NamedPositions, read_anchor_positions
from epipole.io.trajectories.files import PositionLog
from epipole.scale.anchor_views import AnchorViews, positions_at
from epipole.scale.metric_scale import ScaleFit, fit_scale_to_positions
from epipole.scale.scale_agreement import MetricScale, ScaleEstimate, agreed_scale
from epipole.scale.scale_evidence import scale_evidence


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredPositions(Declared):
    """Measured camera positions, fitted to a model."""

    fit: ScaleFit
    positions: Float64[np.ndarray, "n 3"]
    """One per image of the model, in the world; NaN if not measured."""
    sigma: float
    """Standard deviation of a coordinate, as used in the adjustment."""
    num_measured: int

    def estimate(self) -> ScaleEstimate:
        """The scale that the positions determine."""
        kept = int(self.fit.kept_mask.sum())
        words = f"{kept} measured positions of {len(self.fit.kept_mask)}"
        scale = float(self.fit.world_from_model.scale)
        return ScaleEstimate("positions", "measured positions", scale, self.fit.sigma, 0.0, words)


@dataclass(frozen=True, slots=True, eq=False)
class Anchoring(Declared):
    """The similarity that makes a model metric, and its evidence."""

    world_from_model: Similarity3
    """Scales to meters; with used measured positions it also aligns to their world."""
    scale: MetricScale
    positions: MeasuredPositions | None
    """Measured positions that are used, as factors of one more adjustment."""

    def __repr__(self) -> str:
        return f"Anchoring({self.scale!r})"


@checked
def anchor_model(
    views: AnchorViews,
    options: AnchorOptions,
    path: AnchorViews | None = None,
    others: Sequence[ScaleEstimate] = (),
) -> Anchoring:
    """The similarity to meters that agrees with all scale references.

    Args:
        views: images of the model.
        options: the scale references.
        path: all posed images, a superset of `views`; None: the same.
        others: further estimates of the scale.

    Raises:
        DegenerateGeometryError: the scale is unknown, or the references contradict each other.
        FileFormatError: a given file cannot be read.
    """
    everywhere = views if path is None else path
    found, positions, refusals, measured = scale_evidence(views, options, everywhere), None, [], []
    if options.positions is not None:
        log = read_anchor_positions(options.positions)
        try:
            positions = positions_of_views(views, everywhere, log, options.positions_sigma_m)
            measured.append(positions.estimate())
        except DegenerateGeometryError as error:
            refusals.append(f"measured positions: {error}")
    scale = agreed_scale([*others, *measured, *found.estimates], [*refusals, *found.refusals])
    if positions is not None and not scale.kept_mask[len(others)]:
        positions = None
    return Anchoring(_similarity(scale.scale, positions, views), scale, positions)


def _similarity(scale: float, positions: MeasuredPositions | None, views: AnchorViews) -> Similarity3:
    """With the rotation of the measured positions, about the centroid of the cameras."""
    if positions is None:
        return Similarity3(np.asarray(scale), np.eye(3), np.zeros(3))
    fitted = positions.fit.world_from_model
    middle = views.cams_from_world.centers().mean(axis=0)
    there = fitted.apply(middle[None])[0]
    return Similarity3(np.asarray(scale), fitted.rotation, there - scale * fitted.rotation @ middle)


@checked
def positions_of_views(
    views: AnchorViews, path: AnchorViews, log: PositionLog | NamedPositions, sigma: float
) -> MeasuredPositions:
    """Fit measured positions to a model, matched by image time or by image name.

    Args:
        views: images of the model.
        path: all posed images; positions between them are interpolated if they have times.
        log: the measured positions.
        sigma: standard deviation of a coordinate, in meters.

    Raises:
        DegenerateGeometryError: the positions do not determine the scale.
    """
    if isinstance(log, NamedPositions):
        rows = [path.row_of(name) for name in log.names]
        known = np.array([row is not None for row in rows], bool)
        there = path.cams_from_world.centers()[[row for row in rows if row is not None]]
        fit = fit_scale_to_positions(there, log.positions[known], sigma)
        positions = np.full((len(views), 3), np.nan)
        for name, position in zip(log.names, log.positions):
            row = views.row_of(name)
            if row is not None:
                positions[row] = position
    else:
        timed = np.flatnonzero(np.isfinite(path.timestamp_s))
        timed = timed[np.argsort(path.timestamp_s[timed], kind="stable")]
        centers = path.cams_from_world.centers()[timed]
        there = positions_at(path.timestamp_s[timed], centers, log.timestamp_s)
        known = np.isfinite(there[:, 0])
        fit = fit_scale_to_positions(there[known], log.positions[known], sigma)
        positions = positions_at(log.timestamp_s, log.positions, views.timestamp_s)
    # Interpolated positions are correlated: all of them together weigh no more than the measured ones.
    repeats = int(np.isfinite(positions[:, 0]).sum()) / max(int(known.sum()), 1)
    each = max(sigma, fit.residual_m / np.sqrt(3.0)) * float(np.sqrt(max(repeats, 1.0)))
    return MeasuredPositions(fit, positions, each, int(known.sum()))


@checked
def after_adjustment(
    anchoring: Anchoring, before: Float64[np.ndarray, "n 3"], after: Float64[np.ndarray, "n 3"]
) -> Similarity3:
    """Undo the scale change of an adjustment with positions, if other references determine the scale, too.

    Args:
        anchoring: how the scale was determined.
        before: camera positions before the adjustment, in meters.
        after: camera positions after it.
    """
    kinds = {e.kind for e, kept in zip(anchoring.scale.estimates, anchoring.scale.kept_mask) if kept}
    if kinds <= {"positions"}:
        return Similarity3.identity()
    try:
        grown = float(align_points(before, after).scale)
    except DegenerateGeometryError:
        return Similarity3.identity()
    middle = after.mean(axis=0)
    return Similarity3(np.asarray(1.0 / grown), np.eye(3), middle - middle / grown)
