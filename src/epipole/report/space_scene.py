"""What a 3D view holds: points, cameras, lines, triangles and Gaussians, each under a name of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64, UInt8

from epipole.errors import ShapeError
from epipole.geometry import Rigid3
from epipole.scene import Curve
from epipole.scene.gaussian_cloud import GaussianCloud

LoadImage = Callable[[str], UInt8[np.ndarray, "h w 3"] | None]
"""The RGB image of a camera's name, or None where there is none."""
METRES, NO_UNIT = "m", ""
"""Units of a scene; without one it is known up to scale."""


@dataclass(frozen=True, slots=True, eq=False)
class PointMeasure:
    """A number of each point, by which points can be left out and coloured."""

    name: str
    values: Float64[np.ndarray, " n"]
    """Those that are not finite are not known: their points always stay."""
    unit: str = ""
    is_at_least: bool = False
    """The limit is the least value that is shown, else the largest."""


@dataclass(frozen=True, slots=True, eq=False)
class PointLayer:
    """Points, with how wrong each may be where that is known."""

    name: str
    xyz_in_world: Float[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    measures: tuple[PointMeasure, ...] = ()
    covariances: Float[np.ndarray, "n 3 3"] | None = None
    error_words: str = ""
    """What the covariances count."""

    def __post_init__(self) -> None:
        """Check that the columns fit, and that there are two measures at most.

        Raises:
            ShapeError: they do not.
        """
        n = len(self.xyz_in_world)
        lengths = [len(self.rgb), *(len(measure.values) for measure in self.measures)]
        if self.covariances is not None:
            lengths.append(len(self.covariances))
        if any(length != n for length in lengths) or len(self.measures) > 2:
            raise ShapeError("points, colours, errors and at most two measures must be of one number")


@dataclass(frozen=True, slots=True, eq=False)
class CameraLayer:
    """Cameras as frusta: places, lenses without their distortion, and names."""

    name: str
    names: tuple[str, ...]
    cams_from_world: Rigid3
    K: Float64[np.ndarray, "n 3 3"]
    sizes: Int64[np.ndarray, "n 2"]
    """Width and height in pixels."""
    load_image: LoadImage | None = None
    is_shown: bool = True
    """At first."""


@dataclass(frozen=True, slots=True, eq=False)
class MeshLayer:
    """Triangles."""

    name: str
    vertices_in_world: Float[np.ndarray, "n 3"]
    faces: Int64[np.ndarray, "m 3"]
    rgb: UInt8[np.ndarray, "n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class FirstView:
    """From where a scene is seen first."""

    position: Float64[np.ndarray, " 3"]
    look_at: Float64[np.ndarray, " 3"]
    up: Float64[np.ndarray, " 3"]


@dataclass(frozen=True, slots=True, eq=False)
class SpaceScene:
    """Everything that is shown together, in one world."""

    title: str
    words: str
    """What is shown, and of how much, in a sentence."""
    unit: str
    """Of lengths: `METRES`, another, or `NO_UNIT` where the scale is not known."""
    points: tuple[PointLayer, ...] = ()
    cameras: CameraLayer | None = None
    curves: tuple[Curve, ...] = ()
    mesh: MeshLayer | None = None
    gaussians: GaussianCloud | None = None
    view: FirstView | None = None
    """None: from a corner above."""
    upright_from_world: Float64[np.ndarray, "3 3"] | None = None
    """The turn after which +z is up and the corner is behind what looks along +y; None: that is the world as it is."""
    background: float | None = None
    """A grey value from 0 to 1; None: dark, as the page's."""

    def __post_init__(self) -> None:
        """Check that there is something to see.

        Raises:
            ShapeError: there is nothing at all.
        """
        counts = [len(layer.xyz_in_world) for layer in self.points]
        counts += [len(curve.segments_in_world) for curve in self.curves]
        counts += [len(self.cameras.names)] if self.cameras is not None else []
        counts += [len(self.mesh.faces)] if self.mesh is not None else []
        counts += [len(self.gaussians)] if self.gaussians is not None else []
        if not any(counts):
            raise ShapeError("there is nothing to show")
