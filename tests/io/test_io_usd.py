"""Textured meshes as USD files, read back by OpenUSD and checked by its validators."""

import io
import resource
import struct
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pxr import Ar, Usd, UsdGeom, UsdShade
from textured_meshes import BLUE, GREEN, RED, UTM, WHITE, color_at, corner_mesh, large_mesh

from epipole.errors import ConfigError, MissingDependencyError, ShapeError, WorkspaceError
from epipole.io.meshes.usd import require_usd, write_usd
from epipole.scene import TexturedMesh
from whole import IS_WHOLE


def opened(path: Path) -> Usd.Stage:
    return Usd.Stage.Open(str(path))


def image_of(part: UsdGeom.Mesh) -> np.ndarray:
    """The texture that the material of a mesh emits, by way of the asset resolver."""
    material, _ = UsdShade.MaterialBindingAPI(part.GetPrim()).ComputeBoundMaterial()
    surface = material.ComputeSurfaceSource()[0]
    source = surface.GetInput("emissiveColor").GetConnectedSources()[0][0].source
    shader = UsdShade.Shader(source)
    assert shader.GetInput("sourceColorSpace").Get() == "sRGB"
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(shader.GetInput("file").Get().resolvedPath))
    return np.asarray(Image.open(io.BytesIO(asset.GetBuffer())).convert("RGB"))


def parsed(path: Path) -> TexturedMesh:
    """The mesh in world coordinates, with texture coordinates from the top left."""
    stage = opened(path)
    vertices, faces, uv, texture_of_face, textures = [], [], [], [], []
    for prim in stage.Traverse():
        if not prim.IsA(UsdGeom.Mesh):
            continue
        part = UsdGeom.Mesh(prim)
        points = np.array(part.GetPointsAttr().Get(), np.float64)
        corners = np.array(part.GetFaceVertexIndicesAttr().Get(), np.int64).reshape(-1, 3)
        assert (np.array(part.GetFaceVertexCountsAttr().Get()) == 3).all()
        st = UsdGeom.PrimvarsAPI(prim).GetPrimvar("st")
        assert st.GetInterpolation() == "faceVarying" and st.GetTypeName() == "texCoord2f[]"
        coordinates = np.array(st.ComputeFlattened(), np.float64).reshape(-1, 3, 2)
        np.testing.assert_array_equal(part.GetExtentAttr().Get(), [points.min(axis=0), points.max(axis=0)])
        faces.append(corners + sum(map(len, vertices)))
        vertices.append(points)
        uv.append(np.stack([coordinates[..., 0], 1 - coordinates[..., 1]], axis=-1))
        texture_of_face += [len(textures)] * len(corners)
        textures.append(image_of(part))
    origin = np.array(stage.GetRootLayer().customLayerData.get("origin_in_world", (0, 0, 0)))
    points, corners, coordinates = map(np.concatenate, (vertices, faces, uv))
    return TexturedMesh(points + origin, corners, coordinates, np.array(texture_of_face), tuple(textures))


def assert_same(found: TexturedMesh, mesh: TexturedMesh, atol: float = 0.0) -> None:
    corners, expected = (each.vertices_in_world[each.faces] for each in (found, mesh))
    np.testing.assert_allclose(corners, expected, rtol=0, atol=atol)
    np.testing.assert_allclose(found.uv, mesh.uv, atol=2e-7)
    np.testing.assert_array_equal(found.texture_of_face, mesh.texture_of_face)


@pytest.mark.parametrize("suffix", ["usdz", "usdc", "usda"])
def test_a_written_mesh_is_read_back(tmp_path: Path, suffix: str) -> None:
    mesh = corner_mesh()
    write_usd(tmp_path / f"a b.{suffix}", mesh, jpeg_quality=None)
    found = parsed(tmp_path / f"a b.{suffix}")
    assert_same(found, mesh)
    for texture, expected in zip(found.textures, mesh.textures, strict=True):
        np.testing.assert_array_equal(texture, expected)
    beside = [] if suffix == "usdz" else ["a_b_0.png", "a_b_1.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"a b.{suffix}", *beside]


def test_jpeg_textures_keep_their_orientation(tmp_path: Path) -> None:
    mesh = corner_mesh()
    write_usd(tmp_path / "a.usdz", mesh)
    found = parsed(tmp_path / "a.usdz")
    for vertex, color in enumerate((RED, GREEN, WHITE, BLUE)):
        face, corner = np.argwhere(mesh.faces[:2] == vertex)[0]
        seen = color_at(found.textures[0], found.uv[face, corner])
        assert np.abs(seen - color).max() < 12


@pytest.mark.parametrize("changes", [{}, {"up": np.array([0.0, 0.0, 1.0])}, {"jpeg_quality": None}])
@pytest.mark.parametrize("suffix", ["usdz", "usdc", "usda"])
def test_the_validators_of_openusd_find_nothing(tmp_path: Path, suffix: str, changes: dict[str, Any]) -> None:
    validation = pytest.importorskip("pxr.UsdValidation", reason="needs usd-core>=25")
    path = tmp_path / f"a.{suffix}"
    write_usd(path, corner_mesh(UTM), **changes)
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    found = validation.ValidationContext(validators).Validate(opened(path))
    assert not [each.GetMessage() for each in found]


ALLOWED = {
    *("Xform", "Scope", "Mesh", "Material", "Shader"),
    *("UsdPreviewSurface", "UsdUVTexture", "UsdPrimvarReader_float2"),
}
"""Types of prims and shaders that AR Quick Look knows, of those that the file might have."""


def test_the_rules_of_ar_quick_look(tmp_path: Path) -> None:
    """As `UsdUtils.ComplianceChecker(arkit=True)`, which usd-core has no longer."""
    write_usd(tmp_path / "a.usdz", corner_mesh(UTM))
    with zipfile.ZipFile(tmp_path / "a.usdz") as archive:
        assert archive.namelist() == ["model.usdc", "texture_0.jpg", "texture_1.jpg"]
    stage = opened(tmp_path / "a.usdz")
    assert len(stage.GetUsedLayers()) == 2  # the layer of the file and the session's
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.HasAuthoredMetadata("metersPerUnit")
    assert stage.GetDefaultPrim() == stage.GetPrimAtPath("/model")
    kinds = {prim.GetTypeName() for prim in stage.Traverse()}
    shaders = {UsdShade.Shader(prim).GetShaderId() for prim in stage.Traverse() if prim.IsA(UsdShade.Shader)}
    assert kinds | shaders == ALLOWED


def test_archives_are_aligned_and_not_compressed(tmp_path: Path) -> None:
    write_usd(tmp_path / "a.usdz", corner_mesh())
    data = (tmp_path / "a.usdz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.usdz") as archive:
        for info in archive.infolist():
            signature, *_, name_bytes, extra_bytes = struct.unpack_from("<I5H3I2H", data, info.header_offset)
            start = info.header_offset + 30 + name_bytes + extra_bytes
            assert signature == 0x04034B50 and start % 64 == 0
            assert info.compress_type == zipfile.ZIP_STORED and not info.flag_bits
            assert data[start : start + info.file_size] == archive.read(info)
        assert archive.testzip() is None


def test_meshes_are_polygons_that_viewers_do_not_light(tmp_path: Path) -> None:
    write_usd(tmp_path / "a.usdz", corner_mesh())
    stage = opened(tmp_path / "a.usdz")
    part = UsdGeom.Mesh(stage.GetPrimAtPath("/model/part_0"))
    assert part.GetSubdivisionSchemeAttr().Get() == "none" and part.GetDoubleSidedAttr().Get()
    surface = UsdShade.Shader(stage.GetPrimAtPath("/model/materials/texture_0/surface"))
    assert surface.GetInput("diffuseColor").Get() == (0, 0, 0) and surface.GetInput("metallic").Get() == 1
    assert "origin_in_world" not in stage.GetRootLayer().customLayerData


def test_large_coordinates_are_relative_to_an_origin(tmp_path: Path) -> None:
    mesh = corner_mesh(UTM)
    write_usd(tmp_path / "a.usdz", mesh, jpeg_quality=None)
    stage = opened(tmp_path / "a.usdz")
    assert np.abs(np.array(stage.GetRootLayer().customLayerData["origin_in_world"]) - UTM).max() < 2
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/model/part_0")).GetPointsAttr().Get()
    assert np.abs(np.array(points)).max() < 3
    assert_same(parsed(tmp_path / "a.usdz"), mesh, atol=1e-6)
    given = np.array([500_000.0, 5_412_000.0, 0.0])
    write_usd(tmp_path / "b.usdz", mesh, origin_in_world=given)
    stage = opened(tmp_path / "b.usdz")
    assert stage.GetRootLayer().customLayerData["origin_in_world"] == tuple(given)
    assert_same(parsed(tmp_path / "b.usdz"), mesh, atol=5e-5)


@pytest.mark.parametrize("up", [(0, 0, 2), (0, -1, 0), (0, 1, 0), (0.3, -2, 1), (1e200, 1e200, 0)])
def test_the_up_direction_becomes_y(up: tuple[float, float, float], tmp_path: Path) -> None:
    mesh = corner_mesh()
    write_usd(tmp_path / "a.usdz", mesh, up=np.array(up, float))
    stage = opened(tmp_path / "a.usdz")
    unit = np.array(up) / np.abs(up).max()
    unit /= np.linalg.norm(unit)
    np.testing.assert_allclose(stage.GetRootLayer().customLayerData["up_in_world"], unit, atol=1e-12)
    scene_from_part = UsdGeom.Xformable(stage.GetPrimAtPath("/model/part_0")).ComputeLocalToWorldTransform(0)
    np.testing.assert_allclose(scene_from_part.TransformDir(tuple(unit)), [0, 1, 0], atol=1e-12)
    rows = np.array(scene_from_part)[:3, :3]
    np.testing.assert_allclose(rows @ rows.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rows) > 0


def test_textures_beyond_the_edge_repeat_and_unused_ones_are_not_written(tmp_path: Path) -> None:
    mesh = corner_mesh()
    part = TexturedMesh(
        mesh.vertices_in_world, mesh.faces[2:], 3 * mesh.uv[2:], mesh.texture_of_face[2:], mesh.textures
    )
    write_usd(tmp_path / "a.usdz", part, jpeg_quality=None)
    stage = opened(tmp_path / "a.usdz")
    image = UsdShade.Shader(stage.GetPrimAtPath("/model/materials/texture_0/image"))
    assert image.GetInput("wrapS").Get() == image.GetInput("wrapT").Get() == "repeat"
    found = parsed(tmp_path / "a.usdz")
    assert len(found.textures) == 1 and len(found.vertices_in_world) == 4
    np.testing.assert_array_equal(found.textures[0], mesh.textures[1])
    write_usd(tmp_path / "b.usdz", mesh)
    stage = opened(tmp_path / "b.usdz")
    image = UsdShade.Shader(stage.GetPrimAtPath("/model/materials/texture_0/image"))
    assert image.GetInput("wrapS").Get() == "clamp"


@pytest.mark.usefixtures("unchecked")
def test_large_meshes_are_equal_and_give_equal_bytes(tmp_path: Path) -> None:
    mesh = large_mesh(300)
    for name in ("a.usdz", "b.usdz"):
        write_usd(tmp_path / name, mesh)
    assert (tmp_path / "a.usdz").read_bytes() == (tmp_path / "b.usdz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.usdz") as archive:
        assert len(archive.read("model.usdc")) > 1 << 20
    assert_same(parsed(tmp_path / "a.usdz"), mesh, atol=1e-6)
    with zipfile.ZipFile(tmp_path / "a.usdz") as archive:
        assert archive.getinfo("model.usdc").date_time == (1980, 1, 1, 0, 0, 0)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"jpeg_quality": 101}, ConfigError, "jpeg_quality must be from 1 to 100"),
        ({"up": np.zeros(3)}, ShapeError, "up must be a finite, nonzero direction"),
        ({"up": np.array([0, np.inf, 0])}, ShapeError, "up must be"),
        ({"origin_in_world": np.full(3, 1e300)}, ShapeError, "too large for single precision"),
        ({"origin_in_world": np.full(3, np.nan)}, ShapeError, "too large for single precision"),
    ],
)
def test_wrong_arguments_write_nothing(
    changes: dict[str, Any], error: type[Exception], words: str, tmp_path: Path
) -> None:
    for name in ("a.usdz", "a.usdc"):
        with pytest.raises(error, match=words):
            write_usd(tmp_path / name, corner_mesh(), **changes)
    assert not list(tmp_path.iterdir())


def test_wrong_files_and_meshes_write_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = corner_mesh()
    with pytest.raises(ConfigError, match=r"path must end in \.usdz, \.usdc, \.usda, got 'a\.usd'"):
        write_usd(tmp_path / "a.usd", mesh)
    empty = TexturedMesh(
        mesh.vertices_in_world, mesh.faces[:0], mesh.uv[:0], mesh.texture_of_face[:0], mesh.textures
    )
    with pytest.raises(ShapeError, match="no triangles"):
        write_usd(tmp_path / "a.usdz", empty)
    monkeypatch.setattr("epipole.io.meshes._usd_stages._MAX_BYTES", 5000)
    with pytest.raises(ShapeError, match=r"less than 2 GiB: write \.usdc"):
        write_usd(tmp_path / "a.usdz", mesh)
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    for name in ("a.usdz", "a.usdc"):
        with pytest.raises(WorkspaceError, match="cannot write"):
            write_usd(tmp_path / "file" / name, mesh)
    (tmp_path / "b.usdz").mkdir()
    with pytest.raises(WorkspaceError, match="it is a folder"):
        write_usd(tmp_path / "b.usdz", mesh)


FULL = """
import resource, signal, sys
import numpy as np
from epipole.errors import WorkspaceError
from epipole.io.meshes.usd import write_usd
from epipole.scene import TexturedMesh
rng = np.random.default_rng(0)
faces = rng.integers(0, 100_000, (200_000, 3))
mesh = TexturedMesh(rng.normal(size=(100_000, 3)), faces, rng.uniform(size=(200_000, 3, 2)),
                    np.zeros(200_000, np.int64), (np.zeros((8, 8, 3), np.uint8),))
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
try:
    write_usd(sys.argv[1], mesh)
except WorkspaceError as error:
    print("refused:", error)
"""


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="no limit of file sizes")
@pytest.mark.parametrize("suffix", ["usdc"] + IS_WHOLE * ["usdz"])
def test_a_full_disk_leaves_no_file(tmp_path: Path, suffix: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(tmp_path / f"a.{suffix}")], capture_output=True, text=True
    )
    assert "refused: cannot write" in done.stdout, done.stderr
    assert {path.name for path in tmp_path.iterdir()} <= {"a_0.jpg"}


def test_without_usd_core(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    for call in (lambda: write_usd(tmp_path / "a.usdz", corner_mesh()), require_usd):
        with pytest.raises(MissingDependencyError, match=r"pip install 'epipole\[usd\]'"):
            call()
    assert not list(tmp_path.iterdir())
