"""Cameras as columns."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32

from epipole._checks import check_fields, checked
from epipole.cameras import MAX_PARAMS, Camera, CameraModel
from epipole.errors import ConfigError


@dataclass(frozen=True, slots=True, eq=False)
class Cameras:
    """One row per camera; the row is its id inside epipole. `Cameras.from_list` builds them from single cameras."""

    model: Int32[np.ndarray, " n"]
    width: Int32[np.ndarray, " n"]
    height: Int32[np.ndarray, " n"]
    params: Float64[np.ndarray, "n 12"]
    """Padded with zeros to the longest model."""
    is_focal_trusted: Bool[np.ndarray, " n"]
    """Whether the focal length was given or read from EXIF, not guessed."""
    is_constant: Bool[np.ndarray, " n"]
    """Whether the intrinsics are known and stay fixed."""

    def __post_init__(self) -> None:
        """Check the columns.

        Raises:
            ShapeError: a column has the wrong type or shape.
            ConfigError: the camera model is unknown, or a column is not an array.
        """
        for name in self.__slots__:
            if not isinstance(column := getattr(self, name), np.ndarray):
                raise ConfigError(
                    f"{name} of Cameras must be an array with one row per camera, got {type(column).__name__};"
                    " use Cameras.from_list([Camera(...)])"
                )
        check_fields(self)
        known = [int(model) for model in CameraModel]
        if not np.isin(self.model, known).all():
            raise ConfigError(f"model must be from {known[0]} to {known[-1]}, got {self.model}")

    @staticmethod
    @checked
    def from_list(
        cameras: Iterable[Camera],
        is_focal_trusted: Iterable[bool] | None = None,
        is_constant: Iterable[bool] | None = None,
    ) -> Cameras:
        """Collect single cameras into columns (flags default to True and False).

        Raises:
            ConfigError: an item is not a Camera.
        """
        rows = list(cameras)
        wrong = next((row for row in rows if not isinstance(row, Camera)), None)
        if wrong is not None:
            raise ConfigError(f"cameras must be Camera objects, got {type(wrong).__name__}")
        n = len(rows)
        return Cameras(
            np.array([int(c.model) for c in rows], np.int32),
            np.array([c.width for c in rows], np.int32),
            np.array([c.height for c in rows], np.int32),
            np.array([c.padded_params() for c in rows]).reshape(n, MAX_PARAMS),
            np.array(list(is_focal_trusted) if is_focal_trusted is not None else [True] * n, bool),
            np.array(list(is_constant) if is_constant is not None else [False] * n, bool),
        )

    def __len__(self) -> int:
        return len(self.model)

    def __getitem__(self, index: int) -> Camera:
        """Camera of one row."""
        model = CameraModel(int(self.model[index]))
        params = self.params[index, : model.num_params].copy()
        return Camera(model, int(self.width[index]), int(self.height[index]), params)

    def __repr__(self) -> str:
        names = sorted({CameraModel(int(m)).name for m in self.model})
        return f"Cameras({len(self)}: {', '.join(names)})"
