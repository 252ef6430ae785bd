"""Arrays in the files of SfM's units; they are checked because kernels would read out of bounds otherwise."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from epipole._checks.tables import TEXT, Expected, Table
from epipole.errors import WorkspaceError
from epipole.robust import PairKind

FEATURES: Table = {
    "pixels": Expected("float32", "n 2", is_optional=True),
    "scale_px": Expected("float32", "n", is_optional=True),
    "angle_rad": Expected("float32", "n", is_optional=True),
    "descriptors": Expected("uint8", "n d", is_optional=True),
    "colors": Expected("uint8", "n 3", is_optional=True),
    "thumbnail": Expected("uint8", "b", is_optional=True),
    "failure": Expected(TEXT),
}
MATCHES: Table = {
    "pair_keys": Expected(TEXT, "p"),
    "offsets": Expected("int64", "p+1", rises_to="m"),
    "matches": Expected("int32", "m 2", least=0),
}
GEOMETRIES: Table = {
    **MATCHES,
    "kind": Expected("int32", "p", least=min(PairKind), most=max(PairKind)),
    "num_putative": Expected("int32", "p", least=0),
    "rotation": Expected("float64", "p 3 3", may_be_nan=True, is_rotation=True),
    "translation": Expected("float64", "p 3", may_be_nan=True),
    "essential": Expected("float64", "p 3 3", may_be_nan=True),
    "fundamental": Expected("float64", "p 3 3", may_be_nan=True),
    "homography": Expected("float64", "p 3 3", may_be_nan=True),
    "median_angle_rad": Expected("float64", "p", may_be_nan=True),
}


def check_matches(path: Path, matches: np.ndarray, num_features: Sequence[int]) -> None:
    """Check that the features of matches (m, 2) exist in both images.

    Raises:
        WorkspaceError: a feature does not exist.
    """
    if len(matches) and (matches.max(axis=0) >= num_features).any():
        counts = " and ".join(map(str, num_features))
        raise WorkspaceError(
            f"{path} refers to features that its images, with {counts}, do not have; delete it and run the command again"
        )
