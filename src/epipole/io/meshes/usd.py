"""Writing textured meshes as USD files (OpenUSD, Pixar), which Apple's devices, Blender and game engines show, with usd-core.

A USDZ file is a ZIP archive without compression whose files start at multiples of 64 bytes.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import checked
from epipole.errors import ConfigError, EpipoleError, MissingDependencyError, ShapeError
from epipole.io.atomic import atomic_write
from epipole.io.meshes._texture_files import (
    check_textured,
    distinct_rows,
    encoded,
    used_textures,
    write_textures_beside,
)
from epipole.io.meshes.gltf import UP, y_from_up
from epipole.scene.local_origin import ORIGIN, local_origin
from epipole.scene.textured_mesh import TexturedMesh

_SUFFIXES = (".usdz", ".usdc", ".usda")
_ROOT, _MATERIALS = "/model", "/model/materials"
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


@checked
def write_usd(
    path: str | Path,
    mesh: TexturedMesh,
    *,
    jpeg_quality: int | None = 92,
    origin_in_world: Float64[np.ndarray, " 3"] | None = None,
    up: Float64[np.ndarray, " 3"] | None = None,
) -> None:
    """Write a textured mesh as a USD file, which viewers show without shading.

    A `.usdz` file contains its textures. For `mesh.usdc` (binary) or `mesh.usda` (text), they are `mesh_0.jpg`,
    `mesh_1.jpg` and so on in the same folder. There is one mesh for each texture, with a UsdPreviewSurface that emits
    the colors and reflects nothing: photographs already contain the light, and USD has no unlit material.

    Positions are in single precision, relative to an origin. If it is not zero, the layer's `customLayerData` has it as
    `origin_in_world`: add it to the positions, before the rotation of the root prim, to obtain world coordinates. As in
    glTF, one unit is declared as one meter even if the scale of the mesh is unknown. Textures and vertices without
    triangles are not written. Equal meshes give equal files.

    Args:
        path: the file, with the suffix `.usdz`, `.usdc` or `.usda`.
        mesh: the mesh.
        jpeg_quality: quality of the JPEG textures, 1 to 100; None: PNG.
        origin_in_world: the origin; None: `local_origin` of the vertices, which is zero unless they are far from zero.
        up: the up direction in the world, which the root prim's rotation maps to +Y, the up direction of the file; also
            in `customLayerData`, as `up_in_world`. None: no rotation.

    Raises:
        ConfigError: the suffix or the JPEG quality is not valid, or a texture is too large.
        ShapeError: the mesh has no triangles, its coordinates exceed single precision, the up direction is zero or not
            finite, or a USDZ file would be larger than 2 GiB.
        WorkspaceError: a file cannot be written.
        MissingDependencyError: usd-core is not installed.
    """
    path = Path(path)
    if path.suffix.lower() not in _SUFFIXES:
        raise ConfigError(f"path must end in {', '.join(_SUFFIXES)}, got {path.name[:60]!r}")
    check_textured(mesh, jpeg_quality)
    pxr = _pxr()
    origin = local_origin(mesh.vertices_in_world) if origin_in_world is None else origin_in_world
    positions, st = _single_precision(mesh, origin)
    textures, texture_of_face = used_textures(mesh)
    stage = _new_stage(pxr, origin, up)
    is_tiled = bool((st < 0).any() or (st > 1).any())
    images = {}
    if is_package := path.suffix.lower() == ".usdz":
        suffix = "png" if jpeg_quality is None else "jpg"
        images = {f"texture_{k}.{suffix}": encoded(each, jpeg_quality) for k, each in enumerate(textures)}
    names = list(images) if is_package else write_textures_beside(path, textures, jpeg_quality)
    for k, name in enumerate(names):
        is_here = texture_of_face == k
        part = _add_mesh(pxr, stage, f"part_{k}", positions, mesh.faces[is_here], st[is_here])
        _bind_material(pxr, stage, part, f"texture_{k}", name, is_tiled)
    with atomic_write(path) as part_path:
        if is_package:
            _write_package(part_path, stage, images)
        else:
            _export(stage, part_path)


def require_usd() -> None:
    """Check that usd-core is installed, before work whose result needs it.

    Raises:
        MissingDependencyError: it is not.
    """
    _pxr()


def _pxr() -> Any:
    """The modules of usd-core."""
    try:
        from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdShade, Vt
    except ImportError as error:
        problem = "USD files need the package usd-core: pip install 'epipole[usd]'"
        raise MissingDependencyError(problem) from error
    return SimpleNamespace(Gf=Gf, Kind=Kind, Sdf=Sdf, Usd=Usd, UsdGeom=UsdGeom, UsdShade=UsdShade, Vt=Vt)


def _single_precision(mesh: TexturedMesh, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) relative to the origin, and texture coordinates (m, 3, 2) from the bottom left of the texture."""
    with np.errstate(over="ignore", invalid="ignore"):
        positions = (mesh.vertices_in_world - origin).astype(np.float32)
        st = np.stack([mesh.uv[..., 0], 1 - mesh.uv[..., 1]], axis=-1).astype(np.float32)
    if not (np.isfinite(positions).all() and np.isfinite(st).all()):
        raise ShapeError("the coordinates relative to the origin are too large for single precision")
    return positions, st


def _new_stage(pxr: Any, origin: np.ndarray, up: np.ndarray | None) -> Any:
    """A stage in memory with the root prim, whose rotation maps the up direction to +Y."""
    stage = pxr.Usd.Stage.CreateInMemory()
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, _METERS_PER_UNIT)
    root = pxr.UsdGeom.Xform.Define(stage, _ROOT)
    stage.SetDefaultPrim(root.GetPrim())
    pxr.Usd.ModelAPI(root).SetKind(pxr.Kind.Tokens.component)
    extras = {ORIGIN: pxr.Gf.Vec3d(origin.tolist())} if origin.any() else {}
    if up is not None:
        rotation, unit = y_from_up(up)
        extras[UP] = pxr.Gf.Vec3d(unit)
        matrix = np.eye(4)
        matrix[:3, :3] = rotation.matrix.T  # USD multiplies row vectors
        root.AddTransformOp().Set(pxr.Gf.Matrix4d(matrix.tolist()))
    stage.GetRootLayer().customLayerData = {"generator": "epipole", **extras}
    return stage


def _add_mesh(
    pxr: Any, stage: Any, name: str, positions: np.ndarray, faces: np.ndarray, st: np.ndarray
) -> Any:
    """Add triangles (m, 3) with texture coordinates (m, 3, 2); corners with equal ones share them."""
    used, corners = np.unique(faces, return_inverse=True)
    points, st = positions[used], st.reshape(-1, 2)
    first, index = distinct_rows(st[:, 0], st[:, 1])
    vt, names = pxr.Vt, pxr.Sdf.ValueTypeNames
    out = pxr.UsdGeom.Mesh.Define(stage, f"{_ROOT}/{name}")
    out.CreateSubdivisionSchemeAttr(pxr.UsdGeom.Tokens.none)  # the default smooths the mesh
    out.CreateDoubleSidedAttr(True)
    out.CreatePointsAttr(vt.Vec3fArray.FromNumpy(points))
    out.CreateExtentAttr(vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    out.CreateFaceVertexCountsAttr(vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    out.CreateFaceVertexIndicesAttr(vt.IntArray.FromNumpy(corners.ravel().astype(np.int32)))
    coordinates = pxr.UsdGeom.PrimvarsAPI(out).CreatePrimvar(
        "st", names.TexCoord2fArray, pxr.UsdGeom.Tokens.faceVarying
    )
    coordinates.Set(vt.Vec2fArray.FromNumpy(st[first]))
    coordinates.SetIndices(vt.IntArray.FromNumpy(index.astype(np.int32)))
    return out


def _bind_material(pxr: Any, stage: Any, mesh: Any, name: str, texture: str, is_tiled: bool) -> None:
    """Add a material to a mesh that emits the colors of a texture.

    By the specification of UsdPreviewSurface, a black metal reflects nothing, not even at grazing angles.
    """
    shade, names = pxr.UsdShade, pxr.Sdf.ValueTypeNames
    pxr.UsdGeom.Scope.Define(stage, _MATERIALS)
    material = shade.Material.Define(stage, f"{_MATERIALS}/{name}")

    def add_shader(kind: str, identifier: str, **inputs: Any) -> Any:
        shader = shade.Shader.Define(stage, material.GetPath().AppendChild(kind))
        shader.CreateIdAttr(identifier)
        for key, (value_type, value) in inputs.items():
            shader.CreateInput(key, value_type).Set(value)
        return shader

    black = names.Color3f, pxr.Gf.Vec3f(0.0)
    wrap = names.Token, "repeat" if is_tiled else "clamp"
    file, rgb = (names.Asset, pxr.Sdf.AssetPath(f"./{texture}")), (names.Token, "sRGB")
    reader = add_shader("coordinates", "UsdPrimvarReader_float2", varname=(names.String, "st"))
    image = add_shader("image", "UsdUVTexture", file=file, sourceColorSpace=rgb, wrapS=wrap, wrapT=wrap)
    one = names.Float, 1.0
    surface = add_shader("surface", "UsdPreviewSurface", diffuseColor=black, metallic=one, roughness=one)
    coordinates = reader.CreateOutput("result", names.Float2)
    image.CreateInput("st", names.Float2).ConnectToSource(coordinates)
    colors = image.CreateOutput("rgb", names.Float3)
    surface.CreateInput("emissiveColor", names.Color3f).ConnectToSource(colors)
    result = surface.CreateOutput("surface", names.Token)
    material.CreateSurfaceOutput().ConnectToSource(result)
    shade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def _write_package(part: Path, stage: Any, images: dict[str, bytes]) -> None:
    """Write a USDZ archive: the layer comes first."""
    layer_part = part.with_suffix(".usdc")
    try:
        _export(stage, layer_part)
        size = layer_part.stat().st_size + sum(map(len, images.values()))
        if size + (len(images) + 1) * 1024 > _MAX_BYTES:
            raise ShapeError(f"the mesh needs {size} bytes, and USDZ files have less than 2 GiB: write .usdc")
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
