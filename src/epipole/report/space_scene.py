"""The content of a 3D view: named layers of points, cameras, curves, triangles and Gaussians."""

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
"""Returns the RGB image of a camera by name, or None if there is none."""
METERS, NO_UNIT = "m", ""
"""Units of a scene; without a unit, the scale is unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class PointMeasure:
    """A number per point, used to filter and color points."""

    name: str
    values: Float64[np.ndarray, " n"]
    """Values that are not finite are unknown; their points are always shown."""
    unit: str = ""
    is_at_least: bool = False
    """Whether the limit is the smallest value shown; otherwise the largest."""


@dataclass(frozen=True, slots=True, eq=False)
class PointLayer:
    """Points, with the uncertainty of each if known."""

    name: str
    xyz_in_world: Float[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    measures: tuple[PointMeasure, ...] = ()
    covariances: Float[np.ndarray, "n 3 3"] | None = None
    error_words: str = ""
    """Which errors the covariances include."""
    is_shown: bool = True
    """Whether the layer is visible initially."""

    def __post_init__(self) -> None:
        """Check that the columns match, and that there are at most two measures.

        Raises:
            ShapeError: the columns do not match.
        """
        n = len(self.xyz_in_world)
        lengths = [len(self.rgb), *(len(measure.values) for measure in self.measures)]
        if self.covariances is not None:
            lengths.append(len(self.covariances))
        if any(length != n for length in lengths) or len(self.measures) > 2:
            raise ShapeError("points, colors, covariances and at most two measures must have the same length")


@dataclass(frozen=True, slots=True, eq=False)
class CameraLayer:
    """Cameras as frustums: poses, intrinsics without distortion, and names."""

    name: str
    names: tuple[str, ...]
    cams_from_world: Rigid3
    K: Float64[np.ndarray, "n 3 3"]
    sizes: Int64[np.ndarray, "n 2"]
    """Width and height in pixels."""
    load_image: LoadImage | None = None
    load_depth: LoadImage | None = None
    """Returns the depth of a camera as colors, at the pixels of its image."""
    is_shown: bool = True
    """Whether the layer is visible initially."""


@dataclass(frozen=True, slots=True, eq=False)
class MeshLayer:
    """Triangles."""

    name: str
    vertices_in_world: Float[np.ndarray, "n 3"]
    faces: Int64[np.ndarray, "m 3"]
    rgb: UInt8[np.ndarray, "n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class TexturedMeshLayer:
    """Triangles with textures; `textured_layer` makes one."""

    name: str
    vertices_in_world: Float[np.ndarray, "n 3"]
    faces: Int64[np.ndarray, "m 3"]
    uv: Float64[np.ndarray, "m 3 2"]
    """Texture coordinates of the corners of each triangle, as in `TexturedMesh`."""
    texture_of_face: Int64[np.ndarray, " m"]
    jpegs: tuple[bytes, ...]
    """The textures as JPEG files."""
    is_packed: bool = False
    """Whether positions and coordinates are quantized and compressed, for a page that is a file."""


@dataclass(frozen=True, slots=True, eq=False)
class FirstView:
    """The initial viewpoint of a scene."""

    position: Float64[np.ndarray, " 3"]
    look_at: Float64[np.ndarray, " 3"]
    up: Float64[np.ndarray, " 3"]


@dataclass(frozen=True, slots=True, eq=False)
class SpaceScene:
    """All layers shown together, in one world frame."""

    title: str
    words: str
    """A sentence about the content and its size."""
    unit: str
    """Unit of lengths: `METERS`, another, or `NO_UNIT` if the scale is unknown."""
    points: tuple[PointLayer, ...] = ()
    cameras: CameraLayer | None = None
    curves: tuple[Curve, ...] = ()
    mesh: MeshLayer | TexturedMeshLayer | None = None
    gaussians: GaussianCloud | None = None
    view: FirstView | None = None
    """None: from a corner above."""
    upright_from_world: Float64[np.ndarray, "3 3"] | None = None
    """Rotation that makes +z up, with the default viewpoint behind what looks along +y; None: identity."""
    is_enu: bool = False
    """Whether x, y and z of the world point east, north and up."""
    background: float | None = None
    """A gray value from 0 to 1; None: dark, like the page."""

    def __post_init__(self) -> None:
        """Check that the scene is not empty.

        Raises:
            ShapeError: it is empty.
        """
        counts = [len(layer.xyz_in_world) for layer in self.points]
        counts += [len(curve.segments_in_world) for curve in self.curves]
        counts += [len(self.cameras.names)] if self.cameras is not None else []
        counts += [len(self.mesh.faces)] if self.mesh is not None else []
        counts += [len(self.gaussians)] if self.gaussians is not None else []
        if not any(counts):
            raise ShapeError("the scene is empty")
