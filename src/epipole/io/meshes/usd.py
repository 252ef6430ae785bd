"""Writing textured meshes as USD files (OpenUSD, Pixar), which Apple's devices, Blender and game engines show, with usd-core."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import checked
from epipole.errors import ShapeError
from epipole.io.meshes._texture_files import (
    check_textured,
    distinct_rows,
    encoded,
    used_textures,
    write_textures_beside,
)
from epipole.io.meshes._usd_stages import ROOT, check_suffix, new_stage, usd_modules, write_stage
from epipole.scene.local_origin import local_origin
from epipole.scene.textured_mesh import TexturedMesh

_MATERIALS = f"{ROOT}/materials"


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
    check_suffix(path)
    check_textured(mesh, jpeg_quality)
    pxr = usd_modules()
    origin = local_origin(mesh.vertices_in_world) if origin_in_world is None else origin_in_world
    positions, st = _single_precision(mesh, origin)
    textures, texture_of_face = used_textures(mesh)
    stage = new_stage(pxr, origin, up)
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
    write_stage(path, stage, images)


def require_usd() -> None:
    """Check that usd-core is installed, before work whose result needs it.

    Raises:
        MissingDependencyError: it is not.
    """
    usd_modules()


def _single_precision(mesh: TexturedMesh, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) relative to the origin, and texture coordinates (m, 3, 2) from the bottom left of the texture."""
    with np.errstate(over="ignore", invalid="ignore"):
        positions = (mesh.vertices_in_world - origin).astype(np.float32)
        st = np.stack([mesh.uv[..., 0], 1 - mesh.uv[..., 1]], axis=-1).astype(np.float32)
    if not (np.isfinite(positions).all() and np.isfinite(st).all()):
        raise ShapeError("the coordinates relative to the origin are too large for single precision")
    return positions, st


def _add_mesh(
    pxr: Any, stage: Any, name: str, positions: np.ndarray, faces: np.ndarray, st: np.ndarray
) -> Any:
    """Add triangles (m, 3) with texture coordinates (m, 3, 2); corners with equal ones share them."""
    used, corners = np.unique(faces, return_inverse=True)
    points, st = positions[used], st.reshape(-1, 2)
    first, index = distinct_rows(st[:, 0], st[:, 1])
    vt, names = pxr.Vt, pxr.Sdf.ValueTypeNames
    out = pxr.UsdGeom.Mesh.Define(stage, f"{ROOT}/{name}")
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
