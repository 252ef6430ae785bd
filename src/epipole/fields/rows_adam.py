"""Adam for a few parameters per view, each updated only when its view is rendered (Kingma and Ba, ICLR 2015)."""

from __future__ import annotations

import numpy as np

from epipole._checks.tables import Expected, Table

MOMENTUM, SQUARES, LEAST = 0.9, 0.99, 1e-15


class RowsAdam:
    """Adam state of rows that take steps at different times.

    Attributes:
        mean: (n, k) first moments.
        square: (n, k) second moments.
        count: (n,) steps taken.
    """

    def __init__(self, count: int, width: int, rates: tuple[float, float]) -> None:
        """State of `count` rows of `width` parameters; rates: learning rate at the start and at the end."""
        self.mean, self.square = np.zeros((count, width)), np.zeros((count, width))
        self.count, self._rates = np.zeros(count, np.int64), rates

    def step(self, row: int, gradient: np.ndarray, progress: float) -> np.ndarray:
        """Change of a row, given its gradient (k,) and the fraction of the training that is done."""
        self.count[row] += 1
        self.mean[row] += (1 - MOMENTUM) * (gradient - self.mean[row])
        self.square[row] += (1 - SQUARES) * (gradient**2 - self.square[row])
        mean = self.mean[row] / (1 - MOMENTUM ** int(self.count[row]))
        square = self.square[row] / (1 - SQUARES ** int(self.count[row]))
        rate = self._rates[0] * (self._rates[1] / self._rates[0]) ** progress
        return -rate * mean / (np.sqrt(square) + LEAST)

    def table(self, name: str) -> Table:
        """Arrays of `state` with this name."""
        count, width = self.mean.shape
        return {
            f"{name}_mean": Expected("float64", f"{count} {width}"),
            f"{name}_square": Expected("float64", f"{count} {width}", least=0),
            f"{name}_count": Expected("int64", f"{count}", least=0),
        }

    def state(self, name: str) -> dict[str, np.ndarray]:
        """State, with array names that start with `name`."""
        return {f"{name}_mean": self.mean, f"{name}_square": self.square, f"{name}_count": self.count}

    def restore(self, name: str, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state`."""
        self.mean, self.square, self.count = (state[f"{name}_{part}"] for part in ("mean", "square", "count"))
