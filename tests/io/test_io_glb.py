"""Textured meshes as binary glTF: the structure of written files, reading them and those of other programs, and damage."""

import copy
import io
import json
import struct
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from PIL import Image
from textured_meshes import BLUE, GREEN, RED, UTM, WHITE, color_at, corner_mesh, four_colors, large_mesh

from epipole.errors import ConfigError, FileFormatError, ShapeError
from epipole.geometry import Rotation3
from epipole.io.meshes.gltf import read_glb, write_glb
from epipole.scene import TexturedMesh
from hostile_bytes import read_or_refuse
from whole import IS_WHOLE

COMPONENTS = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
LENGTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}


def chunks(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary data, by the layout of the specification."""
    data = path.read_bytes()
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    content = json.loads(data[20 : 20 + size])
    size_of_data, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0" and size_of_data % 4 == 0 and 28 + size + size_of_data == len(data)
    return content, data[28 + size :]


def packed(content: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    parts = (
        struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts


def array_of(content: dict[str, Any], binary: bytes, index: int) -> np.ndarray:
    accessor = content["accessors"][index]
    view = content["bufferViews"][accessor["bufferView"]]
    dtype, columns = np.dtype(COMPONENTS[accessor["componentType"]]), LENGTHS[accessor["type"]]
    assert view["byteOffset"] % 4 == 0 and view["byteOffset"] % dtype.itemsize == 0
    assert view["byteLength"] == accessor["count"] * columns * dtype.itemsize
    values = np.frombuffer(binary, dtype, accessor["count"] * columns, view["byteOffset"])
    return values.reshape(-1, columns)


def assert_same(found: TexturedMesh, mesh: TexturedMesh, atol: float = 0.0) -> None:
    corners, expected = (m.vertices_in_world[m.faces] for m in (found, mesh))
    np.testing.assert_allclose(corners, expected, rtol=0, atol=atol)
    np.testing.assert_allclose(found.uv, mesh.uv, atol=1e-7)
    assert np.array_equal(found.texture_of_face, mesh.texture_of_face)
    for a, b in zip(found.textures, mesh.textures, strict=True):
        assert a.shape == b.shape and np.abs(a.astype(int) - b).mean() < 6


def test_a_written_mesh_is_read_back(tmp_path: Path) -> None:
    mesh = corner_mesh()
    write_glb(tmp_path / "a.glb", mesh)
    found = read_glb(tmp_path / "a.glb")
    assert_same(found, mesh)
    assert len(found.vertices_in_world) == 6, "corners on seams of the texture are one vertex again"
    for vertex, color in enumerate((RED, GREEN, WHITE, BLUE)):
        face, corner = np.argwhere(
            (mesh.vertices_in_world[mesh.faces[:2]] == mesh.vertices_in_world[vertex]).all(-1)
        )[0]
        seen = color_at(found.textures[0], found.uv[face, corner])
        assert np.abs(seen - color).max() < 12


def test_files_have_the_structure_of_the_specification(tmp_path: Path) -> None:
    mesh = corner_mesh()
    write_glb(tmp_path / "a.glb", mesh, jpeg_quality=80)
    content, binary = chunks(tmp_path / "a.glb")
    assert content["asset"] == {"version": "2.0", "generator": "epipole"}
    assert content["extensionsUsed"] == ["KHR_materials_unlit"]
    assert content["buffers"] == [{"byteLength": len(binary)}]
    ends = [view["byteOffset"] + view["byteLength"] for view in content["bufferViews"]]
    starts = [view["byteOffset"] for view in content["bufferViews"]]
    assert (
        all(0 <= start - end < 4 for start, end in zip(starts[1:], ends)) and 0 <= len(binary) - ends[-1] < 4
    )
    assert content["nodes"] == [{"mesh": 0}] and content["scenes"][content["scene"]] == {"nodes": [0]}
    (mesh_entry,) = content["meshes"]
    for k, primitive in enumerate(mesh_entry["primitives"]):
        positions = array_of(content, binary, primitive["attributes"]["POSITION"])
        uv = array_of(content, binary, primitive["attributes"]["TEXCOORD_0"])
        indices = array_of(content, binary, primitive["indices"])[:, 0]
        assert indices.dtype == np.uint16 and len(positions) == len(uv) == 4 and len(indices) == 6
        np.testing.assert_array_equal(
            positions[indices].reshape(-1, 3, 3), mesh.vertices_in_world[mesh.faces[2 * k : 2 * k + 2]]
        )
        np.testing.assert_array_equal(uv[indices].reshape(-1, 3, 2), mesh.uv[2 * k : 2 * k + 2])
        accessor = content["accessors"][primitive["attributes"]["POSITION"]]
        assert accessor["min"] == positions.min(0).tolist() and accessor["max"] == positions.max(0).tolist()
        views = [
            content["accessors"][a]["bufferView"]
            for a in (*primitive["attributes"].values(), primitive["indices"])
        ]
        assert [content["bufferViews"][view]["target"] for view in views] == [34962, 34962, 34963]
        material = content["materials"][primitive["material"]]
        assert material["doubleSided"] is True and material["extensions"] == {"KHR_materials_unlit": {}}
        texture = content["textures"][material["pbrMetallicRoughness"]["baseColorTexture"]["index"]]
        assert content["samplers"][texture["sampler"]]["wrapS"] == 33071
        image = content["images"][texture["source"]]
        view = content["bufferViews"][image["bufferView"]]
        jpeg = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        assert image["mimeType"] == "image/jpeg" and "target" not in view
        assert Image.open(io.BytesIO(jpeg)).size == mesh.textures[k].shape[1::-1]


@pytest.mark.parametrize(("side", "dtype"), [(255, np.uint16), (256, np.uint32)])
def test_many_vertices_have_long_indices(side: int, dtype: type, tmp_path: Path) -> None:
    mesh = large_mesh(side)
    write_glb(tmp_path / "a.glb", mesh)
    content, binary = chunks(tmp_path / "a.glb")
    (primitive,) = content["meshes"][0]["primitives"]
    assert array_of(content, binary, primitive["indices"]).dtype == dtype
    assert len(array_of(content, binary, primitive["attributes"]["POSITION"])) == side * side
    assert_same(read_glb(tmp_path / "a.glb"), mesh, atol=1e-6)


def test_large_coordinates_are_relative_to_an_origin(tmp_path: Path) -> None:
    mesh = corner_mesh(UTM)
    write_glb(tmp_path / "a.glb", mesh)
    content, _ = chunks(tmp_path / "a.glb")
    origin = np.array(content["asset"]["extras"]["origin_in_world"])
    assert np.abs(origin - UTM).max() < 2
    assert np.abs(content["accessors"][0]["max"]).max() < 3
    assert_same(read_glb(tmp_path / "a.glb"), mesh, atol=1e-6)
    given = np.array([500_000.0, 5_412_000.0, 0.0])
    write_glb(tmp_path / "b.glb", mesh, origin_in_world=given)
    assert chunks(tmp_path / "b.glb")[0]["asset"]["extras"] == {"origin_in_world": given.tolist()}
    assert_same(read_glb(tmp_path / "b.glb"), mesh, atol=5e-5)
    write_glb(tmp_path / "c.glb", corner_mesh(), origin_in_world=np.zeros(3))
    assert "extras" not in chunks(tmp_path / "c.glb")[0]["asset"]


@pytest.mark.parametrize(
    "up", [(0, 0, 2), (0, -1, 0), (0, 1, 0), (1e-11, -1, 0), (0.3, -2, 1), (1e200, 1e200, 0)]
)
def test_the_up_direction_becomes_y(up: tuple[float, float, float], tmp_path: Path) -> None:
    mesh = corner_mesh(UTM)
    write_glb(tmp_path / "a.glb", mesh, up=np.array(up, float))
    content, _ = chunks(tmp_path / "a.glb")
    x, y, z, w = content["nodes"][0]["rotation"]
    rotated = Rotation3.from_quat_wxyz([w, x, y, z]).apply(np.array(up) / np.abs(up).max())
    np.testing.assert_allclose(rotated / np.linalg.norm(rotated), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm([x, y, z, w]), 1, rtol=1e-12)
    assert_same(read_glb(tmp_path / "a.glb"), mesh, atol=1e-6)
    scene = read_glb(edited(tmp_path / "a.glb", lambda c, _: c["asset"].pop("extras")))
    height = scene.vertices_in_world[scene.faces][..., 1]
    relative = (mesh.vertices_in_world - UTM)[mesh.faces] @ (np.array(up) / np.abs(up).max())
    relative /= np.linalg.norm(np.array(up) / np.abs(up).max())
    np.testing.assert_allclose(height - height[0, 0], relative - relative[0, 0], atol=1e-6)


def test_textures_beyond_the_edge_repeat_and_unused_ones_are_not_written(tmp_path: Path) -> None:
    mesh = corner_mesh()
    part = TexturedMesh(
        mesh.vertices_in_world, mesh.faces[2:], 3 * mesh.uv[2:], mesh.texture_of_face[2:], mesh.textures
    )
    write_glb(tmp_path / "a.glb", part)
    content, _ = chunks(tmp_path / "a.glb")
    assert (
        content["samplers"][0]["wrapT"] == 10497 and len(content["images"]) == len(content["materials"]) == 1
    )
    found = read_glb(tmp_path / "a.glb")
    assert found.textures[0].shape == mesh.textures[1].shape and not found.texture_of_face.any()
    np.testing.assert_allclose(found.uv, part.uv, atol=1e-6)


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
    with pytest.raises(error, match=words):
        write_glb(tmp_path / "a.glb", corner_mesh(), **changes)
    assert not list(tmp_path.iterdir())


def test_a_mesh_without_triangles_is_rejected(tmp_path: Path) -> None:
    empty = TexturedMesh(
        np.zeros((1, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3, 2)), np.zeros(0, np.int64), ()
    )
    with pytest.raises(ShapeError, match="no triangles"):
        write_glb(tmp_path / "a.glb", empty)


# Files of other programs.


def png(pixels: np.ndarray) -> bytes:
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG")
    return out.getvalue()


def foreign(image: bytes, uv: np.ndarray | None = None) -> tuple[dict[str, Any], bytes]:
    """One triangle without indices, its positions and texture coordinates interleaved, in a scene of two nodes."""
    coordinates = np.array([[0, 0], [1, 0], [0, 1]], "<f4") if uv is None else uv
    kind = {"f": {"componentType": 5126}, "u": {"componentType": 5123, "normalized": True}}[
        coordinates.dtype.kind
    ]
    rows = np.zeros(3, [("xyz", "<f4", 3), ("uv", coordinates.dtype, 2), ("rest", "V4")])
    rows["xyz"], rows["uv"] = [[0, 0, 0], [1, 0, 0], [0, 2, 0]], coordinates
    size = rows.dtype.itemsize
    content = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [1]}],
        "nodes": [
            {"mesh": 0, "scale": [2, 2, 2], "translation": [1, 2, 3]},
            {"children": [0], "matrix": [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 10, 0, 0, 1]},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_1": 1}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 1}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 1, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 0, "byteOffset": 12, "count": 3, "type": "VEC2", **kind},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 3 * size, "byteStride": size},
            {"buffer": 0, "byteOffset": 3 * size, "byteLength": len(image)},
        ],
        "buffers": [{"byteLength": 3 * size + len(image)}],
    }
    return content, rows.tobytes() + image


def test_nodes_interleaved_data_and_png_of_other_programs_are_read(tmp_path: Path) -> None:
    pixels = four_colors(8, 6)
    content, binary = foreign(png(pixels))
    (tmp_path / "a.glb").write_bytes(packed(content, binary))
    mesh = read_glb(tmp_path / "a.glb")
    np.testing.assert_array_equal(mesh.vertices_in_world[mesh.faces[0]], [[8, 1, 3], [8, 3, 3], [4, 1, 3]])
    np.testing.assert_array_equal(mesh.uv[0], [[0, 0], [1, 0], [0, 1]])
    np.testing.assert_array_equal(mesh.textures[0], pixels)
    content["nodes"][0]["scale"] = [2, 2, -2]
    (tmp_path / "a.glb").write_bytes(packed(content, binary))
    mirrored = read_glb(tmp_path / "a.glb")
    np.testing.assert_array_equal(mirrored.uv[0], [[0, 1], [1, 0], [0, 0]])


def test_normalized_texture_coordinates_and_transparent_images_are_read(tmp_path: Path) -> None:
    rgba = np.dstack([four_colors(8, 8), np.full((8, 8), 0, np.uint8)])
    uv = np.array([[0, 0], [65535, 0], [0, 13107]], "<u2")
    (tmp_path / "a.glb").write_bytes(packed(*foreign(png(rgba), uv)))
    mesh = read_glb(tmp_path / "a.glb")
    np.testing.assert_allclose(mesh.uv[0], [[0, 0], [1, 0], [0, 0.2]])
    np.testing.assert_array_equal(mesh.textures[0], rgba[..., :3])
    (tmp_path / "b.glb").write_bytes(packed(*foreign(png(rgba[..., 0]))))
    np.testing.assert_array_equal(
        read_glb(tmp_path / "b.glb").textures[0], np.repeat(rgba[..., :1], 3, axis=2)
    )


Change = Callable[[dict[str, Any], bytearray], Any]


def edited(path: Path, change: Change) -> Path:
    content, binary = chunks(path)
    data = bytearray(binary)
    change(content, data)
    path.write_bytes(packed(content, bytes(data)))
    return path


def put(value: Any, *keys: Any) -> Change:
    """Set a value in the JSON."""

    def change(content: dict[str, Any], _: bytearray) -> None:
        inside: Any = content
        for key in keys[:-1]:
            inside = inside[key]
        inside[keys[-1]] = value

    return change


PRIMITIVE = ("meshes", 0, "primitives", 0)
COLOR = ("materials", 0, "pbrMetallicRoughness")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (put(10**12, "accessors", 0, "count"), "1000000000000 elements, which do not fit"),
        (put(-1, "accessors", 0, "count"), "count must be a nonnegative whole number"),
        (put(True, "accessors", 0, "count"), "count must be"),
        (put(0, "accessors", 0, "count"), "0 elements"),
        (put(3, "accessors", 0, "count"), "POSITION has 3 elements, and TEXCOORD_0 has 4"),
        (put(5, "accessors", 2, "count"), "multiple of three"),
        (put(10**15, "accessors", 0, "byteOffset"), "do not fit"),
        (put({"count": 1}, "accessors", 0, "sparse"), "sparse or compressed"),
        (put("VEC2", "accessors", 0, "type"), "POSITION does not have the type VEC3"),
        (put(5122, "accessors", 2, "componentType"), "not unsigned whole numbers"),
        (put(5122, "accessors", 1, "componentType"), "not normalized"),
        (put([], "accessors", 0, "componentType"), "componentType must be"),
        (put(10**12, "bufferViews", 0, "byteLength"), "ends after the binary data"),
        (put(0, "bufferViews", 0, "byteStride"), "do not fit"),
        (put(1, "bufferViews", 0, "buffer"), "buffers has no entry 1"),
        (put("a.bin", "buffers", 0, "uri"), "data in other files"),
        (put(8, "buffers", 0, "byteLength"), "ends after the binary data"),
        (put(99, *PRIMITIVE, "attributes", "POSITION"), "accessors has no entry 99"),
        (put({"POSITION": 0}, *PRIMITIVE, "attributes"), "has no TEXCOORD_0"),
        (put(5, *PRIMITIVE, "mode"), "triangle strips"),
        (put([], *PRIMITIVE, "targets"), "morph targets"),
        (put([], "meshes", 0, "primitives"), "no triangles"),
        (put({}, "meshes", 0, "primitives"), "primitives is not a list"),
        (put("a", "meshes", 0, "primitives", 0), "a primitive is not a JSON object"),
        (put({}, *COLOR), r"materials\[0\] has no baseColorTexture"),
        (
            put({"KHR_texture_transform": {}}, *COLOR, "baseColorTexture", "extensions"),
            "KHR_texture_transform",
        ),
        (put(7, *COLOR, "baseColorTexture", "index"), "textures has no entry 7"),
        (put({"uri": "a.png"}, "images", 0), "not in the binary data"),
        (put({"bufferView": 0}, "images", 0), "format"),
        (put(0, "nodes", 0, "skin"), "skin"),
        (put([0, 0, 0, 0], "nodes", 0, "rotation"), "not a unit quaternion"),
        (put({"mesh": 0, "scale": [1e308] * 3, "translation": [1e308] * 3}, "nodes", 0), "not finite"),
        (put([1, 2], "nodes", 0, "translation"), "translation"),
        (put([0], "nodes", 0, "children"), "two parents"),
        (put([0, 0], "scenes", 0, "nodes"), "two parents"),
        (put(3, "scene"), "scenes has no entry 3"),
        (put("1.0", "asset", "version"), "glTF version 1.0"),
        (put(["KHR_draco_mesh_compression"], "extensionsRequired"), "KHR_draco_mesh_compression"),
        (put([1, 2, 3], "asset"), "asset is not a JSON object"),
        (put({"origin_in_world": [1, 2]}, "asset", "extras"), "origin_in_world"),
        (put({"up_in_world": [0, 0, 0]}, "asset", "extras"), "unit length"),
        (lambda c, _: c.pop("scenes"), "scenes has no entry 0"),
        (lambda c, _: c["meshes"][0]["primitives"][0].pop("material"), "has no material"),
        (lambda c, b: b.__setitem__(slice(0, 4), b"\0\0\xc0\x7f"), "not finite"),
        (lambda c, b: b.__setitem__(slice(80, 82), b"\xff\x7f"), "missing vertex"),
    ],
)
def test_damaged_and_unsupported_content_is_rejected(change: Change, words: str, tmp_path: Path) -> None:
    write_glb(tmp_path / "a.glb", corner_mesh())
    with pytest.raises(FileFormatError, match=words) as caught:
        read_glb(edited(tmp_path / "a.glb", change))
    assert str(tmp_path) in str(caught.value)


def test_every_truncated_file_is_rejected(tmp_path: Path) -> None:
    write_glb(tmp_path / "a.glb", corner_mesh())
    data = (tmp_path / "a.glb").read_bytes()
    for end in (0, 3, 11, 12, 19, 20, 100, len(data) // 2, len(data) - 1):
        (tmp_path / "b.glb").write_bytes(data[:end])
        with pytest.raises(FileFormatError, match=r"b\.glb"):
            read_glb(tmp_path / "b.glb")
        if end >= 12:  # with a header that says so
            (tmp_path / "b.glb").write_bytes(data[:8] + struct.pack("<I", end) + data[12:end])
            with pytest.raises(FileFormatError, match=r"b\.glb"):
                read_glb(tmp_path / "b.glb")
    for head, words in (
        (b"glTX", "not a binary glTF file"),
        (b"glTF\1\0\0\0", "version 1"),
        (data[:12] + struct.pack("<I", 2**32 - 1), "inside a chunk"),
        (data[:16] + b"BIN\0", "first chunk is not JSON"),
        (data[:20] + b"\xff", "not UTF-8"),
        (data[:20] + b"[", "not JSON"),
    ):
        (tmp_path / "b.glb").write_bytes(head + data[len(head) :])
        with pytest.raises(FileFormatError, match=words):
            read_glb(tmp_path / "b.glb")
    with pytest.raises(FileFormatError, match="does not exist"):
        read_glb(tmp_path / "none.glb")


def many_nodes(content: dict[str, Any], _: bytearray) -> None:
    content["nodes"] = [{"mesh": 0} for _ in range(4_000)]
    content["scenes"] = [{"nodes": list(range(4_000))}]
    content["meshes"][0]["primitives"] *= 20


def test_many_nodes_with_the_same_mesh_do_not_fill_the_memory(tmp_path: Path) -> None:
    write_glb(tmp_path / "a.glb", corner_mesh())
    edited(tmp_path / "a.glb", many_nodes)
    assert read_or_refuse(read_glb, tmp_path / "a.glb", names="many nodes show the same mesh") is None


def values_below(value: Any) -> list[tuple[Any, Any]]:
    """(container, key) of every value."""
    own = list(value.items() if isinstance(value, dict) else enumerate(value))
    return [(value, k) for k, _ in own] + [
        p for _, v in own if isinstance(v, dict | list) for p in values_below(v)
    ]


WRONG = (
    None,
    True,
    "",
    "a",
    [],
    {},
    [[]],
    -1,
    0,
    1,
    2,
    3,
    7,
    0.5,
    1e308,
    -1e308,
    2**31,
    2**53,
    2**63,
    10**30,
    5121,
)


@pytest.mark.usefixtures("unchecked")
def test_other_values_in_the_json_are_rejected_or_harmless(tmp_path: Path) -> None:
    write_glb(tmp_path / "a.glb", corner_mesh(UTM), up=np.array([0.0, -1, 0]))
    valid, binary = chunks(tmp_path / "a.glb")
    random = Random(1)
    for _ in range(600 if IS_WHOLE else 150):
        content = copy.deepcopy(valid)
        for _ in range(random.randint(1, 3)):
            inside, key = random.choice(values_below(content))
            if random.random() < 0.2:
                del inside[key]
            else:
                other, other_key = random.choice(values_below(content))
                inside[key] = copy.deepcopy(random.choice([*WRONG, other[other_key]]))
        (tmp_path / "b.glb").write_bytes(packed(content, binary))
        mesh = read_or_refuse(read_glb, tmp_path / "b.glb", names="b.glb")
        assert mesh is None or len(mesh)
