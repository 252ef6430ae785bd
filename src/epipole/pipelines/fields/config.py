"""Options of `epipole splat`, `nerf`, `render` and `mesh`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

from epipole._checks import check_options
from epipole.errors import ConfigError
from epipole.fields.config import NerfTraining, SplatTraining

USUAL_TIME = "5m"
_UNITS_S = {"s": 1.0, "m": 60.0, "h": 3600.0}
_DURATION = re.compile(r"(\d+(?:\.\d+)?)([smh]?)")


def check_cluster(address: str | None) -> None:
    """Check the address of a cluster, if there is one.

    Raises:
        ConfigError: it has no known form.
    """
    if address is not None:
        from epipole.runs.cluster import Cluster

        Cluster(address)


Background = Literal["auto", "white", "black"]


@dataclass(frozen=True, kw_only=True)
class FieldOptions:
    """Options for images and training time."""

    time: str | None = None
    """Training time: 30s, 5m or 1h; 5m by default. The result depends on the speed of the machine."""
    steps: int | None = None
    """Number of steps instead of a time: same result on any machine."""
    test_every: int = 8
    """Hold out every n-th image for evaluation; 0: none. A dataset's own test split takes precedence."""
    test: str | None = None
    """Names of the images to hold out instead, separated by commas."""
    max_side_px: int = 800
    """Downscale larger images to this longest side."""
    background: Background = "auto"
    """Background color: white if images are transparent, else black."""
    masks: Path | None = None
    """Folder of masks, MASKS/NAME.png; black pixels are neither trained on nor compared."""
    cluster: str | None = None
    """Reconstruct photographs, and render held-out views of `nerf`, on a Dask cluster: tcp://HOST:PORT, tls://HOST:PORT, local:N, slurm:N."""
    shared_folder: bool = True
    """All machines of the cluster see images and output folder under the same paths; otherwise files are sent."""
    view: bool = False
    """Watch the training in the browser; costs at most a tenth of the time."""
    port: int | None = None
    """Port of the live view; None: 8080, or the next free one."""
    host: str = "127.0.0.1"
    """Address of the live view; 0.0.0.0 allows access from other machines."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range, or both time and steps are given.
        """
        check_options(self)
        check_cluster(self.cluster)
        if self.time is not None and self.steps is not None:
            raise ConfigError("time and steps exclude each other: give one of them")
        if self.steps is not None and not 1 <= self.steps < 10**9:
            raise ConfigError(f"steps must be 1 or more, got {self.steps}")
        if self.test_every < 0 or self.test_every == 1:
            raise ConfigError(f"test_every must be 0 (hold out none), or 2 or more, got {self.test_every}")
        if not 16 <= self.max_side_px <= 65536:
            raise ConfigError(f"max_side_px must be from 16 to 65536, got {self.max_side_px}")
        _ = self.seconds

    @property
    def seconds(self) -> float | None:
        """Training time in seconds; None if the number of steps is given.

        Raises:
            ConfigError: the time has no unit or cannot be parsed.
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
            raise ConfigError(f"time must be a number with a unit, such as 30s, 5m or 1h, got {words!r}")
        return float(found[1]) * _UNITS_S[found[2]]


@dataclass(frozen=True, kw_only=True)
class SplatConfig(SplatTraining, FieldOptions):
    """Options of `splat`: images, duration and training."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        FieldOptions.__post_init__(self)
        SplatTraining.__post_init__(self)


@dataclass(frozen=True, kw_only=True)
class NerfConfig(NerfTraining, FieldOptions):
    """Options of `nerf`: images, duration and training."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        FieldOptions.__post_init__(self)
        NerfTraining.__post_init__(self)


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """Options of `render`: cameras, image size and output."""

    cameras: Path | None = None
    """Cameras to render from: transforms.json, COLMAP model or output folder."""
    path: Literal["auto", "cameras", "orbit"] = "auto"
    """Without --cameras: a smooth path along the training cameras, or an orbit; auto: an orbit if its options are given."""
    frames: int = 120
    """Number of images of the path."""
    rotation_deg: float = 360.0
    """Angle of the orbit."""
    width: int | None = None
    """Image width; default: the width of the cameras, or 800 for an orbit."""
    height: int | None = None
    """Image height of an orbit; default: 3/4 of the width."""
    fov_deg: float = 50.0
    """Horizontal field of view of the orbit."""
    fps: float = 30.0
    """Frames per second of a video."""
    background: Background = "auto"
    """Background color; auto: that of the training if it is known, otherwise black."""
    antialiased: bool | None = None
    """Render with Mip-Splatting's filter; None: as in training."""
    output: Literal["color", "depth", "normals", "coverage"] = "color"
    """What to render; depth has colors from near (blue) to far (red), normals are (n + 1) / 2 in the camera frame."""
    cluster: str | None = None
    """Render images on a Dask cluster: tcp://HOST:PORT, tls://HOST:PORT, local:N or slurm:N."""
    shared_folder: bool = True
    """All machines of the cluster see field and output folder under the same paths; otherwise files are sent."""

    @property
    def orbit_options(self) -> tuple[str, ...]:
        """Options that only an orbit has, as far as they differ from the defaults."""
        names = ("rotation_deg", "height", "fov_deg")
        return tuple(name for name in names if getattr(self, name) != getattr(RenderConfig, name, None))

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        if cast(str, self.output) == "colour":  # the British spelling
            object.__setattr__(self, "output", "color")
        check_options(self, negative=("rotation_deg",))
        check_cluster(self.cluster)
        if self.orbit_options and (self.path == "cameras" or self.cameras is not None):
            raise ConfigError(
                f"{self.orbit_options[0]} is an option of the orbit: leave it out, or render an orbit (path=orbit, no cameras)"
            )
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
    """Options of `mesh`: cameras and resolution."""

    cameras: Path | None = None
    """Cameras to render depth from: transforms.json, COLMAP model or output folder; else those of the training."""
    voxels: int = 256
    """Voxels along the longest side of the box."""
    max_views: int = 100
    """Maximum number of cameras, evenly spaced over all."""
    box_fraction: float = 0.98
    """Fraction of the field, along each axis, inside the box; excludes distant and isolated parts."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Mesh only this box (lowest x y z, then highest x y z), instead of --box-fraction."""
    min_component: float = 0.01
    """Remove components with fewer triangles than this fraction of the largest one; 0 keeps all."""
    width: int | None = None
    """Width of the depth images, or larger if the voxels need it; that of the cameras."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        check_options(self)
        if not 8 <= self.voxels <= 1024:
            raise ConfigError(f"voxels must be from 8 to 1024, got {self.voxels}")
        if self.max_views < 1:
            raise ConfigError(f"max_views must be 1 or more, got {self.max_views}")
        if not 0.0 < self.box_fraction <= 1.0:
            raise ConfigError(f"box_fraction must be above 0 and at most 1, got {self.box_fraction}")
        if not 0.0 <= self.min_component <= 1.0:
            raise ConfigError(f"min_component must be from 0 to 1, got {self.min_component}")
        if self.box is not None and not all(low < high for low, high in zip(self.box[:3], self.box[3:])):
            raise ConfigError(
                f"box must be six numbers, the lowest x y z and then the highest x y z, got {self.box}"
            )
        if self.width is not None and not 1 <= self.width <= 16384:
            raise ConfigError(f"width must be from 1 to 16384, got {self.width}")
