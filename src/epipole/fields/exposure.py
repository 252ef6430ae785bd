"""Color transform of each image, which compensates for automatic exposure and white balance.

An affine transform x' = A x + b is learned for each image and applied to the render before the comparison
(Kerbl et al., "A hierarchical 3D Gaussian representation", ACM TOG 2024).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64

from epipole import _parallel
from epipole._checks import check_count, check_fraction, check_index, checked
from epipole._checks.tables import Expected, Table
from epipole.errors import ConfigError, ShapeError
from epipole.fields import _photometric_kernels as kernels
from epipole.fields.rows_adam import RowsAdam
from epipole.fields.splat.rasterizer import Rendering

IDENTITY = np.eye(3, 4, dtype=np.float32)
TOGETHER = 16_384
"""Pixels processed as one task."""
MOST_CONDITION = 1e6
"""Largest condition number of the mean of restored transforms; in training they stay near the identity."""
RATES = 1e-2, 1e-3
"""Learning rate at the start and at the end of training."""


class Exposures:
    """A color transform for each image.

    Attributes:
        maps: (views, 3, 4), [A b] of each view.
    """

    @checked
    def __init__(self, num_views: int) -> None:
        """Start with the identity for each view.

        Raises:
            ConfigError: num_views is not positive, or too large.
        """
        if num_views < 1:
            raise ConfigError(f"num_views must be positive, got {num_views}")
        check_count(num_views, "num_views")
        self.maps = np.tile(IDENTITY, (num_views, 1, 1))
        self._adam = RowsAdam(num_views, 12, RATES)

    @checked
    def applied(
        self, view: int, rendered: Rendering, background: Float32[np.ndarray, " 3"]
    ) -> Float32[np.ndarray, "h w 3"]:
        """Apply the transform of a view to a render; the background is not transformed.

        Raises:
            ConfigError: there is no such view.
        """
        check_index(view, "view", len(self.maps))
        out = np.empty_like(rendered.color)
        color, coverage = rendered.color.reshape(-1, 3), rendered.coverage.reshape(-1)
        _parallel.map_chunks(
            lambda a, b, _: kernels.map_colors(
                color, coverage, self.maps[view], background, a, b, out.reshape(-1, 3)
            ),
            len(coverage),
            -(-len(coverage) // TOGETHER),
        )
        return out

    @checked
    def learn(
        self,
        view: int,
        rendered: Rendering,
        background: Float32[np.ndarray, " 3"],
        by_applied: Float32[np.ndarray, "h w 3"],
        progress: float,
    ) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
        """Update the transform of a view.

        Args:
                view: index of the view.
                rendered: render before the transform.
                background: (3,) background color.
                by_applied: (h, w, 3) derivative of the loss w.r.t. the result of `applied`.
                progress: fraction of the training that is done.

        Returns:
                Derivatives of the loss w.r.t. color (h, w, 3) and coverage (h, w) of the render.

        Raises:
                ConfigError: there is no such view, or progress is not from 0 to 1.
                ShapeError: by_applied has another size than the render.
        """
        check_index(view, "view", len(self.maps))
        check_fraction(progress, "progress")
        if by_applied.shape != rendered.color.shape:
            raise ShapeError(f"by_applied must be {rendered.color.shape}, got {by_applied.shape}")
        by_color, by_coverage = np.empty_like(rendered.color), np.empty_like(rendered.coverage)
        known = rendered.color.reshape(-1, 3), rendered.coverage.reshape(-1), self.maps[view], background
        by, out = by_applied.reshape(-1, 3), (by_color.reshape(-1, 3), by_coverage.reshape(-1))

        def back(start: int, stop: int, _: int) -> np.ndarray:
            total = np.zeros(12)
            kernels.map_colors_back(*known, by, start, stop, *out, np.empty(12, np.float32), total)
            return total

        found = _parallel.map_chunks(back, len(by), -(-len(by) // TOGETHER))
        step = self._adam.step(view, np.sum([np.zeros(12), *found], axis=0), progress)
        self.maps[view] += step.reshape(3, 4)
        return by_color, by_coverage

    def taken_mean(self) -> Float32[np.ndarray, "3 4"]:
        """Remove the mean transform from all maps and return it: it cannot be separated from the scene's own colors."""
        mean = self.maps.astype(np.float64).mean(axis=0)
        rotation = self.maps[:, :, :3] @ np.linalg.inv(mean[:, :3])
        self.maps[:, :, 3] -= (rotation @ mean[:, 3]).astype(np.float32)
        self.maps[:, :, :3] = rotation
        return mean.astype(np.float32)

    @property
    def table(self) -> Table:
        """Arrays of `state`."""
        maps = Expected("float32", f"{len(self.maps)} 3 4")
        return {"exposure_maps": maps, **self._adam.table("exposure")}

    def state(self) -> dict[str, np.ndarray]:
        """All state that the next steps depend on."""
        return {"exposure_maps": self.maps, **self._adam.state("exposure")}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state`.

        Raises:
            ShapeError: the mean of the transforms cannot be inverted.
        """
        mean = state["exposure_maps"].astype(np.float64).mean(axis=0)[:, :3]
        if not np.linalg.cond(mean) < MOST_CONDITION:
            raise ShapeError("the mean of exposure_maps cannot be inverted")
        self.maps = state["exposure_maps"]
        self._adam.restore("exposure", state)


@checked
def color_match(
    image: Float32[np.ndarray, "h w 3"], truth: Float32[np.ndarray, "h w 3"]
) -> Float64[np.ndarray, "3 4"]:
    """Least-squares color transform [A b] from an image to a reference.

    Held-out images have an unknown exposure; after this transform their scores depend on the scene alone.

    Raises:
        ShapeError: the images are empty or not finite.
    """
    flat, wanted = (part.reshape(-1, 3).astype(np.float64) for part in (image, truth))
    if not flat.size or not (np.isfinite(flat).all() and np.isfinite(wanted).all()):
        raise ShapeError("image and truth must not be empty and must be finite")
    known = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
    return np.linalg.lstsq(known, wanted, rcond=None)[0].T
