"""Options of `epipole surface`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from epipole._checks import check_options
from epipole.errors import ConfigError

STAGES = ("depth", "cloud", "mesh", "texture", "survey")
FORMATS = ("glb", "obj", "ply", "usdz")
_FIRST_USED = {
    "mesh": ("voxel", "min_component", "close", "faces"),
    "texture": ("texture_px", "formats"),
    "survey": ("resolution_m", "crs", "crop", "contour_m"),
}
"""Options that have no effect in a run that ends before a stage; `crs` has one with `laz`, too."""


@dataclass(frozen=True, kw_only=True)
class SurfaceConfig:
    """Options of `epipole surface`; the defaults suit objects, rooms and facades."""

    until: Literal["depth", "cloud", "mesh", "texture", "survey"] = "texture"
    """Last stage: depth, cloud, mesh, texture, or survey (height model, orthophoto, LAZ)."""
    max_size_px: int = 1600
    """Longer side at which images are matched; larger ones are downscaled."""
    sources: int = 5
    """Number of other views that each view is matched with."""
    images: Path | None = None
    """Folder of the images. Default: next to the model."""
    masks: Path | None = None
    """Folder of masks: NAME.png, black where a pixel is not used."""
    voxel: float | None = None
    """Side of a voxel of the mesh. Default: from the resolution of the views."""
    min_component: float = 0.002
    """Remove parts of the mesh with fewer triangles than this fraction of the largest."""
    close: float = 0.0
    """Close holes up to this width, relative to the size of the mesh, such as 0.05. Default: holes stay."""
    faces: int | None = None
    """Simplify the mesh to at most this number of triangles, where possible."""
    texture_px: int = 4096
    """Width of the texture, and its largest height."""
    formats: tuple[Literal["glb", "obj", "ply", "usdz"], ...] = ("glb",)
    """Formats of the textured mesh."""
    laz: bool = False
    """Also write the cloud as LAZ, in the coordinate system of `crs` if the model has a position on Earth."""
    resolution_m: float | None = None
    """survey: side of a cell. Default: a pixel at the median depth, rounded up to 1, 2 or 5 times a power of ten."""
    crs: str | None = None
    """survey and laz: coordinate system, such as EPSG:25832. Default: UTM."""
    crop: tuple[float, float, float, float] | None = None
    """survey: west, south, east and north border in the coordinate system."""
    contour_m: float | None = None
    """survey: height between contour lines. Default: 16 to 40 lines."""
    cluster: str | None = None
    """Process images on a Dask cluster: tcp://HOST:PORT, tls://HOST:PORT, local:N or slurm:N."""
    shared_folder: bool = True
    """All machines of the cluster see images and output folder under the same paths; otherwise files are sent."""
    threads: int | None = None
    """Number of threads. Default: all cores."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is out of range.
        """
        check_options(self)
        if not 64 <= self.max_size_px <= 16384:
            raise ConfigError(f"max_size_px must be from 64 to 16384, got {self.max_size_px}")
        if not 1 <= self.sources <= 20:
            raise ConfigError(f"sources must be from 1 to 20, got {self.sources}")
        if self.voxel is not None and not self.voxel > 0:
            raise ConfigError(f"voxel must be positive, got {self.voxel}")
        if not 0 <= self.min_component <= 1:
            raise ConfigError(f"min_component must be from 0 to 1, got {self.min_component}")
        if not 0 <= self.close <= 1:
            raise ConfigError(f"close must be from 0 to 1, got {self.close}")
        if self.faces is not None and self.faces < 4:
            raise ConfigError(f"faces must be at least 4, got {self.faces}")
        if not 256 <= self.texture_px <= 16384:
            raise ConfigError(f"texture_px must be from 256 to 16384, got {self.texture_px}")
        if not self.formats:
            raise ConfigError("formats must name at least one format of the textured mesh")
        if self.laz and self.until == "depth":
            raise ConfigError("laz needs the cloud: pass until=cloud or a later stage")
        if self.resolution_m is not None and not self.resolution_m > 0:
            raise ConfigError(f"resolution_m must be positive, got {self.resolution_m}")
        if self.crop is not None and not (self.crop[0] < self.crop[2] and self.crop[1] < self.crop[3]):
            raise ConfigError(
                f"crop must be west, south, east, north with west < east and south < north, got {self.crop}"
            )
        if self.contour_m is not None and not self.contour_m > 0:
            raise ConfigError(f"contour_m must be positive, got {self.contour_m}")
        if self.cluster is not None:
            from epipole.runs import Cluster  # not needed for --help

            Cluster(self.cluster)
        if self.threads is not None and self.threads < 1:
            raise ConfigError(f"threads must be at least 1, got {self.threads}")

    def unused(self) -> list[str]:
        """A note for each option that was passed but has no effect, since the run ends before the stage that uses it."""
        notes = []
        for stage, names in _FIRST_USED.items():
            if STAGES.index(stage) <= STAGES.index(self.until):
                continue
            used = {"crs"} if self.laz else set()
            passed = [name for name in names if name not in used and getattr(self, name) != _default(name)]
            notes += [
                f"--{name.replace('_', '-')} has no effect, since this run ends with {self.until} (--until):"
                f" it is used by {stage}{' and --laz' if name == 'crs' else ''}"
                for name in passed
            ]
        return notes


def _default(name: str) -> object:
    return SurfaceConfig.__dataclass_fields__[name].default
