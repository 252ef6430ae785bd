"""Textured meshes: drawn with their colors, served as they are, shared with fewer triangles and pixels, picked; surfaces."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_viewer_controls import pixel_of
from test_viewer_kinds import Opened, image
from viewer_scenes import free_port, three_cameras

import epipole
from epipole import api
from epipole.errors import FileFormatError
from epipole.io import write_colmap_model
from epipole.io.meshes.gltf import write_glb
from epipole.io.meshes.mesh_ply import write_mesh_ply
from epipole.io.meshes.ply import write_points_ply
from epipole.pipelines.viewing.run import scene_of, write_page
from epipole.report.packed_mesh import depth_first
from epipole.report.space import space_data
from epipole.report.space_scene import MeshLayer, SpaceScene, TexturedMeshLayer
from epipole.report.texture_gaps import without_gaps
from epipole.report.textured_layer import corners_of, reduced, textured_layer
from epipole.runs import claim
from epipole.scene.mesh_simplification import Corners, simplified
from epipole.scene.textured_mesh import TexturedMesh

COLORS = np.array([[200, 40, 40], [40, 180, 40], [40, 40, 220], [220, 200, 40]], np.uint8)
"""Of the quarters of the texture: top left, top right, bottom left, bottom right."""
QUARTERS = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [-0.5, -0.5, 0], [0.5, -0.5, 0]])
SIZE = {"width": 600, "height": 500}


def quad(side_px: int = 64) -> TexturedMesh:
    """A square in the plane z = 0, +y up, seen from +z; its texture has four colors."""
    vertices = np.array([[-1.0, 1, 0], [1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    faces = np.array([[0, 2, 1], [1, 2, 3]])
    half = side_px // 2
    texture = COLORS.reshape(2, 2, 3).repeat(half, axis=0).repeat(half, axis=1)
    return TexturedMesh(
        vertices, faces, (vertices[faces][..., :2] * [1, -1] + 1) / 2, np.zeros(2, int), (texture,)
    )


def grid(n: int, side_px: int, height: float = 0.05) -> TexturedMesh:
    """A wavy square of 2 n^2 triangles in two charts, which meet at x = 0.5; a noisy texture."""
    x, y = (a.ravel() / n for a in np.meshgrid(np.arange(n + 1), np.arange(n + 1)))
    vertices = np.stack([x, y, height * np.sin(9 * x) * np.cos(7 * y)], axis=1)
    first = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.stack([first, first + 1, first + n + 1, first + 1, first + n + 2, first + n + 1], axis=1)
    faces = faces.reshape(-1, 3)
    noise = np.random.default_rng(0).integers(0, 255, (side_px, side_px, 3), dtype=np.uint8)
    return TexturedMesh(vertices, faces, uv_of(vertices[faces]), np.zeros(len(faces), int), (noise,))


def uv_of(corners: np.ndarray) -> np.ndarray:
    """Two charts: the right half of the square is lower in the texture, and upside down."""
    x, y = corners[..., 0], corners[..., 1]
    is_right = (x.mean(axis=1) > 0.5)[:, None]
    return np.stack(
        [np.where(is_right, 1.0 - 0.9 * x, 0.9 * x), np.where(is_right, 0.9 - 0.4 * y, 0.4 * y)], axis=2
    )


@pytest.fixture(scope="module")
def opened(browser: Any) -> Iterator[Opened]:
    found = Opened(browser, None, **SIZE)
    yield found
    found.close()


def check_colors(tab: Opened) -> None:
    """Each quarter has its color: the texture is neither mirrored nor upside down."""
    rendered = tab.rendered()
    box = tab.page.locator("#space").bounding_box()
    origin = origin_of(tab)
    for center, color in zip(QUARTERS, COLORS):
        x, y = pixel_of(tab, center - origin)
        found = rendered[int(y - box["y"]), int(x - box["x"])]
        np.testing.assert_allclose(found, color, atol=12)


def origin_of(tab: Opened) -> np.ndarray:
    return np.array(tab.page.evaluate("space.then(s => s.data.origin)"))


def test_a_textured_mesh_has_its_colors_and_is_picked(opened: Opened, tmp_path: Path) -> None:
    write_glb(tmp_path / "quad.glb", quad())
    handle = api.view(tmp_path / "quad.glb", port=free_port(), block=False)
    try:
        opened.open(handle.url)
        check_colors(opened)
        assert "Textured mesh, 2" in opened.page.locator(".drawer").first.text_content()
        opened.page.click("#measure")
        for position in QUARTERS[:2]:
            opened.page.mouse.click(*pixel_of(opened, position - origin_of(opened)))
        length = float(opened.page.locator("#measured").get_attribute("data-length"))
        assert length == pytest.approx(1.0, abs=0.02)
        opened.page.keyboard.press("Escape")
        opened.page.click("summary:has-text('Layers')")
        opened.page.click("[data-layer=mesh].show-layer")
        empty = opened.rendered()
        assert np.ptp(empty.reshape(-1, 3), axis=0).max() < 5
    finally:
        handle.stop()
    page = api.share(tmp_path / "quad.glb", tmp_path / "page.html")
    opened.open(page.as_uri())
    check_colors(opened)
    assert page.stat().st_size < 400_000
    vertices = opened.page.evaluate("space.then(s => Array.from(s.drawn.mesh.vertices))")
    found = np.array(vertices).reshape(-1, 3) + origin_of(opened)
    np.testing.assert_allclose(sorted(found.tolist()), sorted(quad().vertices_in_world.tolist()), atol=1e-4)


SLOW = """const decode = createImageBitmap;
createImageBitmap = (...given) => new Promise((ready) => (window.release = () => ready(decode(...given))));"""
SMALL = """const get = WebGL2RenderingContext.prototype.getParameter;
WebGL2RenderingContext.prototype.getParameter = function (name) {
  return name === WebGL2RenderingContext.MAX_TEXTURE_SIZE ? 16 : get.call(this, name);
};"""


def test_the_page_draws_before_the_texture_is_decoded(browser: Any, tmp_path: Path) -> None:
    write_glb(tmp_path / "quad.glb", quad())
    page = api.share(tmp_path / "quad.glb", tmp_path / "page.html")
    tab = Opened(browser, None, **SIZE)
    tab.page.add_init_script(SLOW)
    tab.page.goto(page.as_uri())
    tab.page.wait_for_selector("#no-drawing", state="hidden")
    middle = "space.then(({ gl, snapshot }) => new Promise((done) => snapshot(() => done(1))))"
    assert tab.page.evaluate(middle) == 1
    assert tab.page.evaluate("document.getElementById('space').dataset.settled") == "no"
    tab.page.evaluate("release()")
    tab.improve()
    check_colors(tab)
    tab.close()


def test_a_texture_larger_than_the_device_allows_is_scaled(browser: Any, tmp_path: Path) -> None:
    write_glb(tmp_path / "quad.glb", quad())
    page = api.share(tmp_path / "quad.glb", tmp_path / "page.html")
    tab = Opened(browser, None, **SIZE)
    tab.page.add_init_script(SMALL)
    tab.open(page.as_uri())
    check_colors(tab)
    tab.close()


def test_a_shared_page_is_limited_and_says_what_it_lacks(tmp_path: Path) -> None:
    write_glb(tmp_path / "grid.glb", grid(120, 1024), jpeg_quality=95)
    served = scene_of(tmp_path / "grid.glb").mesh
    assert isinstance(served, TexturedMeshLayer) and len(served.faces) == 28_800
    page = write_page(tmp_path / "grid.glb", tmp_path / "page.html", 20_000)
    assert 100_000 < page.num_bytes < 300_000
    assert "of 28\N{NARROW NO-BREAK SPACE}800 triangles" in page.shown


def test_a_simplified_mesh_keeps_its_border_its_seam_and_its_coordinates() -> None:
    layer = textured_layer("grid", grid(60, 64))
    corners, _ = corners_of(layer)
    small = simplified(corners, 1500)
    assert 500 < len(small.triangles) <= 1500
    found = small.positions[small.vertex[small.triangles]]
    np.testing.assert_allclose(small.uv[small.triangles], uv_of(found), atol=1e-9)
    sides = found[:, 1:, :2] - found[:, :1, :2]
    areas = 0.5 * (sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
    assert areas.min() > 0 and areas.sum() == pytest.approx(1.0)  # no fold, no hole, straight sides
    middle = found.mean(axis=1)
    off = np.abs(middle[:, 2] - 0.05 * np.sin(9 * middle[:, 0]) * np.cos(7 * middle[:, 1]))
    assert off.max() < 0.004


def test_what_cannot_be_simplified_stays_whole() -> None:
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    corners = np.random.default_rng(0).uniform(0, 1, (12, 2))  # four charts of one triangle each
    tetrahedron = Corners(np.eye(4)[:, :3], faces.ravel(), corners, np.arange(12).reshape(4, 3))
    assert len(simplified(tetrahedron, 1).triangles) == 4
    corners, _ = corners_of(textured_layer("quad", quad()))
    assert len(simplified(corners, 2).triangles) == 2


def test_the_order_of_triangles_has_each_once() -> None:
    corners, _ = corners_of(textured_layer("grid", grid(20, 64)))
    order = depth_first(corners.triangles, len(corners.vertex))
    np.testing.assert_array_equal(np.sort(order), np.arange(800))


def test_textures_of_several_sizes_are_reduced_together() -> None:
    one = grid(20, 512)
    half = np.arange(800) % 2
    mesh = TexturedMesh(one.vertices_in_world, one.faces, one.uv, half, (one.textures[0], quad().textures[0]))
    layer = reduced(textured_layer("two", mesh), 60_000)
    data = space_data(SpaceScene("two", "", "", mesh=layer))
    given = data.numbers["mesh"]["textures"]
    assert [each["count"] for each in given] == [400, 400] and given[1]["first"] == 400
    assert 8 * given[1]["width"] == pytest.approx(given[0]["width"], abs=4) and given[0]["width"] < 512
    assert len(data.blocks) == 3 and sum(map(len, data.blocks.values())) < 60_000


def test_gaps_of_a_texture_get_the_colors_around_them() -> None:
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:, :20] = (200, 100, 50)
    texture[30:34, 5:9] = 0  # black, but used
    uv = np.array([[[0.0, 0], [0.28, 0], [0, 1]], [[0.28, 0], [0.28, 1], [0, 1]]])
    filled = without_gaps(texture, uv)
    np.testing.assert_array_equal(filled[:, :18], texture[:, :18])
    np.testing.assert_allclose(filled[:, 24:], np.broadcast_to([200, 100, 50], (64, 40, 3)), atol=12)
    np.testing.assert_array_equal(without_gaps(texture, uv - 0.5), texture)  # repeats


def surface_folder(folder: Path, names: list[str]) -> Path:
    """An output folder of `surface` with some of its files, and of the model that it was made from."""
    model = folder / "model"
    write_colmap_model(three_cameras(40), model / "sparse" / "0")
    image(model / "images" / "a.jpg")
    out = claim(folder / "out", "surface", [model])
    mesh = quad()
    with out.publish("surface") as aside:
        view = np.array([[0.0, 0, 5], [0, 0, 0], [0, 1, 0]])
        rgb = np.full((4, 3), 90, np.uint8)
        if "glb" in names:
            write_glb(aside / "textured.glb", mesh)
        if "mesh" in names:
            write_mesh_ply(aside / "mesh.ply", mesh.vertices_in_world, mesh.faces, rgb, view)
        if "cloud" in names:
            write_points_ply(aside / "cloud.ply", mesh.vertices_in_world, rgb)
    return folder / "out"


def test_a_surface_is_shown_with_its_cameras_and_its_hidden_cloud(tmp_path: Path) -> None:
    out = surface_folder(tmp_path, ["glb", "mesh", "cloud"])
    scene = scene_of(out)
    assert isinstance(scene.mesh, TexturedMeshLayer) and scene.title == "model"
    assert scene.words == "2 triangles with a texture of 64 x 64 pixels, 4 points, 2 images"
    assert not scene.points[0].is_shown and scene.view is not None
    np.testing.assert_allclose(scene.view.position, [0, 0, 5])
    assert scene.cameras is not None and scene.cameras.load_image is not None
    assert scene.cameras.load_image("a.jpg") is not None
    assert space_data(scene).numbers["points"][0]["shown"] is False
    page = write_page(out, tmp_path / "page.html", 1000)
    assert page.shown.endswith("; here without the dense cloud")
    given = json.loads(page.file.read_text().partition('id="space-data">')[2].partition("</script>")[0])
    assert given["points"] == [] and given["mesh"]["count"] == 2 and given["cameras"]["images"]
    assert isinstance(epipole.load(out), TexturedMesh)
    assert isinstance(epipole.load(out / "textured.glb"), TexturedMesh)


def test_a_surface_without_texture_or_mesh_shows_what_it_has(tmp_path: Path) -> None:
    out = surface_folder(tmp_path / "mesh", ["mesh", "cloud"])
    assert isinstance(scene_of(out).mesh, MeshLayer) and len(epipole.load(out).faces) == 2
    out = surface_folder(tmp_path / "cloud", ["cloud"])
    scene = scene_of(out)
    assert scene.mesh is None and scene.points[0].is_shown and len(epipole.load(out).faces) == 0
    (tmp_path / "cloud" / "model" / "sparse" / "0" / "images.bin").unlink()
    assert scene_of(out).cameras is None
    out = surface_folder(tmp_path / "none", [])
    for use in (scene_of, epipole.load):
        with pytest.raises(FileFormatError, match="it has no surface"):
            use(out)


def test_a_damaged_glb_is_refused(tmp_path: Path) -> None:
    (tmp_path / "bad.glb").write_bytes(b"glTF and no more")
    for use in (scene_of, epipole.load):
        with pytest.raises(FileFormatError):
            use(tmp_path / "bad.glb")
