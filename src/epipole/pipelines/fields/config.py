"""Options of `epipole splat`, `nerf`, `render` and `mesh`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from epipole._declared import check_options
from epipole.errors import ConfigError
from epipole.fields.config import NerfTraining, SplatTraining

USUAL_TIME = "5m"
_UNITS_S = {"s": 1.0, "m": 60.0, "h": 3600.0}
_DURATION = re.compile(r"(\d+(?:\.\d+)?)([smh]?)")

Background = Literal["auto", "white", "black"]


@dataclass(frozen=True, kw_only=True)
class FieldOptions:
    """What is taken of the images, and for how long is trained."""

    time: str | None = None
    """How long to train: 30s, 5m or 1h; 5m unless steps are given. The result depends on the machine's speed."""
    steps: int | None = None
    """Steps instead of a time: the same result on any machine."""
    test_every: int = 8
    """Every so many images one is held out and compared in the end; 0: none. Sets with a test split of their own keep it."""
    test: str | None = None
    """Names of images that are held out instead, separated by commas."""
    max_side_px: int = 800
    """Larger images are shrunk to this longest side."""
    background: Background = "auto"
    """Colour behind everything: white for images with transparency, else black."""
    masks: Path | None = None
    """Folder of masks, MASKS/NAME.png: where a mask is black an image is neither learnt from nor compared."""
    view: bool = False
    """Watch the training in the browser; it takes at most a tenth of its time."""
    port: int | None = None
    """Of the live view; None: 8080, or the next free one."""
    host: str = "127.0.0.1"
    """Address of the live view; 0.0.0.0 lets other machines in."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_options(self, negative=("rotation_deg",))
        if self.time is not None and self.steps is not None:
            raise ConfigError("time and steps are two ways to say how long: give one")
        if self.steps is not None and not 1 <= self.steps < 10**9:
            raise ConfigError(f"steps must be 1 or more, got {self.steps}")
        if self.test_every < 0 or self.test_every == 1:
            raise ConfigError("test_every must be 0 (hold out none), or 2 or more")
        if not 16 <= self.max_side_px <= 65536:
            raise ConfigError(f"max_side_px must be from 16 to 65536, got {self.max_side_px}")
        _ = self.seconds

    @property
    def seconds(self) -> float | None:
        """For how long is trained; None where steps are counted.

        Raises:
            ConfigError: the time is not understood.
        """
        if self.steps is not None:
            return None
        words = (USUAL_TIME if self.time is None else self.time).strip()
        found = _DURATION.fullmatch(words)
        if found is not None and not found[2]:
            raise ConfigError(
                f"time needs a unit: {words}s for seconds, {words}m for minutes or {words}h for hours, got {words!r}"
            )
        if found is None or not 0 < float(found[1]) < 1e7:
            raise ConfigError(f"time is a number with its unit, such as 30s, 5m or 1h, got {words!r}")
        return float(found[1]) * _UNITS_S[found[2]]


@dataclass(frozen=True, kw_only=True)
class SplatConfig(SplatTraining, FieldOptions):
    """Options of `splat`: images, duration and training."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        FieldOptions.__post_init__(self)
        SplatTraining.__post_init__(self)


@dataclass(frozen=True, kw_only=True)
class NerfConfig(NerfTraining, FieldOptions):
    """Options of `nerf`: images, duration and training."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        FieldOptions.__post_init__(self)
        NerfTraining.__post_init__(self)


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """From where a field is drawn, and how large."""

    cameras: Path | None = None
    """Draw from these cameras: a transforms.json, a COLMAP model or an output folder; else on a circle around the scene."""
    frames: int = 120
    """Images of the circle."""
    rotation_deg: float = 360.0
    """How far the circle goes round."""
    width: int | None = None
    """Of the images; as the cameras' own, 800 for a circle."""
    height: int | None = None
    """Of the circle's images; 3/4 of the width."""
    fov_deg: float = 50.0
    """Across, of the circle's camera."""
    fps: float = 30.0
    """Images a second of a video."""
    background: Background = "auto"
    """Colour behind everything: as it was trained, else black."""
    antialiased: bool | None = None
    """With Mip-Splatting's filter; None: if it was trained with it."""
    output: Literal["colour", "depth", "normals", "coverage"] = "colour"
    """What is drawn. Depth in colours, near blue, far red, the same for all images; normals as (n + 1) / 2 in the camera's axes."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_options(self, negative=("rotation_deg",))
        if not 1 <= self.frames <= 1_000_000:
            raise ConfigError(f"frames must be from 1 to a million, got {self.frames}")
        for name in ("width", "height"):
            size = getattr(self, name)
            if size is not None and not 1 <= size <= 16384:
                raise ConfigError(f"{name} must be from 1 to 16384, got {size}")
        if not 1.0 <= self.fov_deg <= 170.0:
            raise ConfigError(f"fov_deg must be from 1 to 170, got {self.fov_deg}")
        if not 0.0 < self.fps <= 1000.0:
            raise ConfigError(f"fps must be above 0 and at most 1000, got {self.fps}")
        if not -3600.0 <= self.rotation_deg <= 3600.0:
            raise ConfigError(f"rotation_deg must be within 3600 degrees, got {self.rotation_deg}")


@dataclass(frozen=True, kw_only=True)
class MeshConfig:
    """From where a field's depth is drawn, and how fine the mesh is."""

    cameras: Path | None = None
    """Draw depth from these cameras: a transforms.json, a COLMAP model or an output folder; else from those of the training."""
    voxels: int = 256
    """Along the longest side of the box."""
    most_views: int = 100
    """Cameras that are used, spread over all."""
    around: float = 0.98
    """Share of what the field holds, along each axis, that the box takes in: the rest is far away or alone."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Mesh this box of the world alone (x y z of its lowest corner, x y z of its highest), instead of --around."""
    least_component: float = 0.01
    """Remove components with fewer triangles than this fraction of the largest one; 0 keeps all."""
    width: int | None = None
    """Of the depth images; as the cameras' own."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value makes no sense.
        """
        check_options(self, negative=("rotation_deg",))
        if not 8 <= self.voxels <= 1024:
            raise ConfigError(f"voxels must be from 8 to 1024, got {self.voxels}")
        if self.most_views < 1:
            raise ConfigError(f"most_views must be 1 or more, got {self.most_views}")
        if not 0.0 < self.around <= 1.0:
            raise ConfigError(f"around must be above 0 and at most 1, got {self.around}")
        if not 0.0 <= self.least_component <= 1.0:
            raise ConfigError(f"least_component must be from 0 to 1, got {self.least_component}")
        if self.box is not None and not all(low < high for low, high in zip(self.box[:3], self.box[3:])):
            raise ConfigError(
                f"box must be six numbers, the lowest x y z and then the highest, got {self.box}"
            )
        if self.width is not None and not 1 <= self.width <= 16384:
            raise ConfigError(f"width must be from 1 to 16384, got {self.width}")
