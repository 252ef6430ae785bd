"""What fixes a model's scale and world, from options and files to one similarity; for photographs and SLAM alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from epipole._declared import Declared, checked
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
    """Measured places of the cameras of a model, fitted to it."""

    fit: ScaleFit
    positions: Float64[np.ndarray, "n 3"]
    """Of each of the model's images, in the world; NaN for none."""
    sigma: float
    """Standard deviation of a coordinate with which they enter an adjustment."""
    num_measured: int

    def estimate(self) -> ScaleEstimate:
        """What they say of the scale."""
        kept = int(self.fit.kept_mask.sum())
        words = f"{kept} measured places of {len(self.fit.kept_mask)}"
        scale = float(self.fit.world_from_model.scale)
        return ScaleEstimate("positions", "measured places", scale, self.fit.sigma, 0.0, words)


@dataclass(frozen=True, slots=True, eq=False)
class Anchoring(Declared):
    """How a model becomes metric."""

    world_from_model: Similarity3
    """To metres; and to the world of the measured places, where they count."""
    scale: MetricScale
    positions: MeasuredPositions | None
    """Measured places that count: factors of one more adjustment."""

    def __repr__(self) -> str:
        return f"Anchoring({self.scale!r})"


@checked
def anchor_model(
    views: AnchorViews,
    options: AnchorOptions,
    path: AnchorViews | None = None,
    others: Sequence[ScaleEstimate] = (),
) -> Anchoring:
    """The similarity to metres on which all that is known agrees.

    Args:
        views: images of the model.
        options: what is known.
        path: all images with a place, of which `views` are some; None: the same.
        others: what else is known of the scale.

    Raises:
        DegenerateGeometryError: nothing tells the scale, or what tells it contradicts itself; the message says why.
        FileFormatError: a file that was named cannot be read.
    """
    everywhere = views if path is None else path
    found, positions, refusals, measured = scale_evidence(views, options, everywhere), None, [], []
    if options.positions is not None:
        log = read_anchor_positions(options.positions)
        try:
            positions = positions_of_views(views, everywhere, log, options.positions_sigma_m)
            measured.append(positions.estimate())
        except DegenerateGeometryError as error:
            refusals.append(f"measured places: {error}")
    scale = agreed_scale([*others, *measured, *found.estimates], [*refusals, *found.refusals])
    if positions is not None and not scale.kept_mask[len(others)]:
        positions = None
    return Anchoring(_similarity(scale.scale, positions, views), scale, positions)


def _similarity(scale: float, positions: MeasuredPositions | None, views: AnchorViews) -> Similarity3:
    """With the measured places' rotation, about their middle."""
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
    """Fit measured places to a model, by the images' times or by their names.

    Args:
        views: images of the model.
        path: all images with a place; the places between them are interpolated where they have times.
        log: what was measured.
        sigma: standard deviation of a coordinate, in metres.

    Raises:
        DegenerateGeometryError: the places do not tell a scale; the message says why.
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
    # Interpolated places repeat each other: together they weigh no more than the measured ones.
    repeats = int(np.isfinite(positions[:, 0]).sum()) / max(int(known.sum()), 1)
    each = max(sigma, fit.residual_m / np.sqrt(3.0)) * float(np.sqrt(max(repeats, 1.0)))
    return MeasuredPositions(fit, positions, each, int(known.sum()))


@checked
def after_adjustment(
    anchoring: Anchoring, before: Float64[np.ndarray, "n 3"], after: Float64[np.ndarray, "n 3"]
) -> Similarity3:
    """What undoes the change of scale that an adjustment with places alone brought, where other things fix the scale, too.

    Args:
        anchoring: what fixed the scale.
        before: places of the cameras before the adjustment, in metres.
        after: after it.
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
