"""One scale from several estimates: which of them agree, their combined value and its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool

from epipole._checks import Declared, checked
from epipole.errors import ConfigError, DegenerateGeometryError

AGREE = 3.0  # estimates agree if they differ by at most this many standard deviations
TOLERANCE = 0.02  # or by this fraction, as a model's own scale drifts
LARGEST_FRACTION = 0.1
"""Largest accepted relative standard deviation."""


@dataclass(frozen=True, slots=True, eq=False)
class ScaleEstimate(Declared):
    """The scale according to one reference."""

    kind: str
    """GPS, positions, length, tag, board, odometry or imu."""
    name: str
    scale: float
    """Meters per model unit."""
    sigma: float
    """Standard deviation of the scale, without `shared_sigma`."""
    shared_sigma: float = 0.0
    """Relative standard deviation common to all estimates of this kind, such as that of the stated size."""
    note: str = ""
    """Source of the estimate, in words."""

    @property
    def fraction(self) -> float:
        """Relative standard deviation, including the shared part."""
        return float(np.hypot(self.sigma / self.scale, self.shared_sigma))

    def __repr__(self) -> str:
        return f"ScaleEstimate({self.name}: {self.scale:.6g} +- {100 * self.fraction:.2g} %)"


@dataclass(frozen=True, slots=True, eq=False)
class MetricScale(Declared):
    """A model's scale and the estimates that determine it."""

    scale: float
    """Meters per model unit."""
    sigma: float
    """Standard deviation of the scale."""
    estimates: tuple[ScaleEstimate, ...]
    kept_mask: Bool[np.ndarray, " n"]
    """Estimates that agree."""
    refusals: tuple[str, ...] = field(default=())
    """References that give no scale, and why."""

    @property
    def relative_sigma(self) -> float:
        """Standard deviation relative to the scale."""
        return self.sigma / self.scale

    def in_words(self) -> str:
        """The source of the scale and its uncertainty, as a sentence."""
        kept = [e for e, k in zip(self.estimates, self.kept_mask) if k]
        parts = [
            _counted(kind, [e for e in kept if e.kind == kind])
            for kind in dict.fromkeys(e.kind for e in kept)
        ]
        return f"meters, from {' and '.join(parts)}: known to {100 * self.relative_sigma:.2g} % (1 sigma)"

    def warnings(self) -> list[str]:
        """References that are ignored, and why."""
        out = list(self.refusals)
        for estimate, kept in zip(self.estimates, self.kept_mask):
            if not kept:
                off = 100.0 * (estimate.scale / self.scale - 1.0)
                out.append(
                    f"{estimate.name} is ignored: it would change the scale by {off:+.2g} %, with a stated uncertainty of "
                    f"{100 * estimate.fraction:.2g} %"
                )
        return out

    def summary(self) -> dict[str, object]:
        """Numbers and words for a job's summary."""
        return {
            "scale": self.scale,
            "relative_sigma": self.relative_sigma,
            "estimates": [
                {
                    "kind": e.kind,
                    "name": e.name,
                    "scale": e.scale,
                    "relative_sigma": e.fraction,
                    "kept": bool(k),
                    "from": e.note,
                }
                for e, k in zip(self.estimates, self.kept_mask)
            ],
        }

    def __repr__(self) -> str:
        return f"MetricScale({self.scale:.6g} +- {self.sigma:.2g}, {int(self.kept_mask.sum())} of {len(self.estimates)})"


@checked
def agreed_scale(estimates: Sequence[ScaleEstimate], refusals: Sequence[str] = ()) -> MetricScale:
    """The scale on which most estimates agree: the minimum-variance mean of its logarithm.

    Estimates of one kind are combined first, adding their shared part once; then the kinds. If estimates scatter by more
    than their standard deviations allow, the result's standard deviation grows with the scatter.

    Args:
        estimates: of one model's scale; independent, except for the shared part of each kind.
        refusals: references that give no scale, and why.

    Raises:
        DegenerateGeometryError: there is no estimate, they contradict each other, or the result is too uncertain.
        ConfigError: a scale or standard deviation is not positive.
    """
    given = tuple(estimates)
    if not all(e.scale > 0 and np.isfinite(e.scale) and 0 < e.sigma < np.inf for e in given):
        raise ConfigError("scales and their standard deviations must be positive and finite")
    if not given:
        raise DegenerateGeometryError(
            "; ".join(refusals) or "the scale is unknown, as no reference was given"
        )
    logs = np.log([e.scale for e in given])
    kept = _agreeing(given, logs)
    rows = [
        _of_kind([e for e, k in zip(given, kept) if k and e.kind == kind]) for kind in _kinds(given, kept)
    ]
    mean, sigma = _weighed(np.array([r[0] for r in rows]), np.array([r[1] for r in rows]))
    if sigma > LARGEST_FRACTION:
        names = ", ".join(e.name for e, k in zip(given, kept) if k)
        raise DegenerateGeometryError(f"{names}: the scale is too uncertain ({100 * sigma:.0f} %)")
    scale = float(np.exp(mean))
    return MetricScale(scale, scale * sigma, given, kept, tuple(refusals))


def _kinds(estimates: Sequence[ScaleEstimate], kept: np.ndarray) -> list[str]:
    return list(dict.fromkeys(e.kind for e, k in zip(estimates, kept) if k))


def _agreeing(estimates: Sequence[ScaleEstimate], logs: np.ndarray) -> np.ndarray:
    """The largest set that agrees with one estimate; an error unless it is the majority."""
    fraction = np.array([e.fraction for e in estimates])
    apart = np.abs(logs[:, None] - logs)
    near = apart <= np.maximum(AGREE * np.hypot(fraction[:, None], fraction), TOLERANCE)
    counts = near.sum(axis=1)
    best = min(np.flatnonzero(counts == counts.max()), key=lambda n: fraction[n])
    if 2 * counts[best] <= len(estimates):
        words = "; ".join(f"{e.name} {e.scale:.4g} +- {100 * e.fraction:.2g} %" for e in estimates[:6])
        raise DegenerateGeometryError(
            f"the scale references contradict each other (meters per model unit: {words})"
        )
    return near[best]


def _of_kind(estimates: Sequence[ScaleEstimate]) -> tuple[float, float]:
    mean, sigma = _weighed(
        np.log([e.scale for e in estimates]), np.array([e.sigma / e.scale for e in estimates])
    )
    return mean, float(np.hypot(sigma, max(e.shared_sigma for e in estimates)))


def _weighed(values: np.ndarray, sigmas: np.ndarray) -> tuple[float, float]:
    weights = 1.0 / sigmas**2
    mean = float((weights * values).sum() / weights.sum())
    scatter = 1.0
    if len(values) > 1:
        scatter = max(1.0, float((weights * (values - mean) ** 2).sum()) / (len(values) - 1))
    return mean, float(np.sqrt(scatter / weights.sum()))


def _counted(kind: str, estimates: Sequence[ScaleEstimate]) -> str:
    if kind in ("GPS", "positions", "odometry", "imu"):
        return estimates[0].note or estimates[0].name
    return estimates[0].name if len(estimates) == 1 else f"{len(estimates)} {kind}s"
