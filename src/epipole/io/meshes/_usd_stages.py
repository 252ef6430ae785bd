"""Stages of OpenUSD, and their files: layers, and USDZ archives.

A USDZ file is a ZIP archive without compression whose files start at multiples of 64 bytes.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from epipole.errors import ConfigError, EpipoleError, MissingDependencyError, ShapeError
from epipole.io.atomic import atomic_write
from epipole.io.georeference import georeference_fields
from epipole.io.meshes.gltf import UP, y_from_up
from epipole.scene import Georeference
from epipole.scene.local_origin import ORIGIN

SUFFIXES = (".usdz", ".usdc", ".usda")
GEOREFERENCE = "georeference"
"""Key in `customLayerData` of the position of the world's origin on Earth, with the content of georeference.json."""
ROOT = "/model"
"""Path of the root prim."""
_METERS_PER_UNIT = 1.0
"""Without this entry, readers assume centimeters."""
_ALIGNMENT = 64
"""Start of each file in a USDZ archive, in bytes."""
_LOCAL_HEADER_BYTES, _EXTRA_HEADER_BYTES = 30, 4
"""ZIP: a file's header without its name, and the header of an extra field, which fills up to the alignment."""
_PADDING_ID = 0x1986
"""Identifier of that extra field in the archives of OpenUSD."""
_FIRST_DATE = (1980, 1, 1, 0, 0, 0)
"""Date of all files in an archive, the earliest that ZIP has: equal meshes give equal bytes."""
_MAX_BYTES = 2**31 - 1
"""Size up to which the module zipfile writes archives without ZIP64, which USDZ does not allow."""
_COPIED_AT_ONCE = 1 << 20
"""Bytes."""


def check_suffix(path: Path) -> None:
    """Check that a path has the suffix of a USD file.

    Raises:
        ConfigError: it has another.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"path must end in {', '.join(SUFFIXES)}, got {path.name[:60]!r}")


def usd_modules() -> Any:
    """The modules of usd-core.

    Raises:
        MissingDependencyError: it is not installed.
    """
    try:
        from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdShade, Vt
    except ImportError as error:
        problem = "USD files need the package usd-core: pip install 'epipole[usd]'"
        raise MissingDependencyError(problem) from error
    return SimpleNamespace(Gf=Gf, Kind=Kind, Sdf=Sdf, Usd=Usd, UsdGeom=UsdGeom, UsdShade=UsdShade, Vt=Vt)


def new_stage(
    pxr: Any, origin: np.ndarray, up: np.ndarray | None, georeference: Georeference | None = None
) -> Any:
    """A stage in memory with the root prim, whose rotation maps the up direction to +Y.

    Args:
        pxr: modules of `usd_modules`.
        origin: origin of the coordinates in the world, recorded unless it is zero.
        up: up direction in the world; None: no rotation.
        georeference: position of the world's origin on Earth, recorded if it is known.
    """
    stage = pxr.Usd.Stage.CreateInMemory()
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, _METERS_PER_UNIT)
    root = pxr.UsdGeom.Xform.Define(stage, ROOT)
    stage.SetDefaultPrim(root.GetPrim())
    pxr.Usd.ModelAPI(root).SetKind(pxr.Kind.Tokens.component)
    extras = {ORIGIN: pxr.Gf.Vec3d(origin.tolist())} if origin.any() else {}
    if georeference is not None:
        extras[GEOREFERENCE] = georeference_fields(georeference)
    if up is not None:
        rotation, unit = y_from_up(up)
        extras[UP] = pxr.Gf.Vec3d(unit)
        matrix = np.eye(4)
        matrix[:3, :3] = rotation.matrix.T  # USD multiplies row vectors
        root.AddTransformOp().Set(pxr.Gf.Matrix4d(matrix.tolist()))
    stage.GetRootLayer().customLayerData = {"generator": "epipole", **extras}
    return stage


def write_stage(path: Path, stage: Any, images: Mapping[str, bytes]) -> None:
    """Write a stage as a layer, or as a USDZ archive with images.

    Raises:
        ShapeError: a USDZ file would be larger than 2 GiB.
        WorkspaceError: the file cannot be written.
    """
    with atomic_write(path) as part:
        if path.suffix.lower() == ".usdz":
            _write_package(part, stage, images)
        else:
            _export(stage, part)


def _write_package(part: Path, stage: Any, images: Mapping[str, bytes]) -> None:
    """Write a USDZ archive: the layer comes first."""
    layer_part = part.with_suffix(".usdc")
    try:
        _export(stage, layer_part)
        size = layer_part.stat().st_size + sum(map(len, images.values()))
        if size + (len(images) + 1) * 1024 > _MAX_BYTES:
            raise ShapeError(
                f"the stage needs {size} bytes, and USDZ files have less than 2 GiB: write .usdc"
            )
        with part.open("wb") as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
            with (
                layer_part.open("rb") as source,
                archive.open(_aligned("model.usdc", stream.tell()), "w") as out,
            ):
                while block := source.read(_COPIED_AT_ONCE):
                    out.write(block)
            for name, data in images.items():
                with archive.open(_aligned(name, stream.tell()), "w") as out:
                    out.write(data)
    finally:
        layer_part.unlink(missing_ok=True)


def _aligned(name: str, start: int) -> zipfile.ZipInfo:
    """The header, at a position of the archive, of a file whose data start at a multiple of 64 bytes."""
    info = zipfile.ZipInfo(name, _FIRST_DATE)
    info.create_system = 0  # the same on all platforms
    padding = -(start + _LOCAL_HEADER_BYTES + len(name) + _EXTRA_HEADER_BYTES) % _ALIGNMENT
    info.extra = _PADDING_ID.to_bytes(2, "little") + padding.to_bytes(2, "little") + bytes(padding)
    return info


def _export(stage: Any, path: Path) -> None:
    with _written_by_usd():
        if not stage.GetRootLayer().Export(str(path)):
            raise OSError("OpenUSD cannot write the layer")


@contextmanager
def _written_by_usd() -> Iterator[None]:
    """Convert the exceptions of OpenUSD.

    Raises:
        OSError: OpenUSD cannot write the file.
    """
    try:
        yield
    except (EpipoleError, OSError):
        raise
    except Exception as error:  # OpenUSD's exceptions have no base class of their own
        words = str(error).strip().splitlines() or [type(error).__name__]
        raise OSError(f"OpenUSD reports: {words[-1].strip()}") from error
