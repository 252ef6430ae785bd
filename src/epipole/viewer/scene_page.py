"""A page with a 3D view: a self-contained file, or a page whose data come from a server."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from epipole.report.frame import render
from epipole.report.markup import count
from epipole.report.space import SpaceData, embedded_images, of_all, space_data
from epipole.report.space_scene import METERS, NO_UNIT, SpaceScene, TexturedMeshLayer
from epipole.report.textured_layer import reduced

BYTES_PER_ITEM = 10
"""Bytes of a page with a textured mesh for each of its `most` points: 5 MB by default."""
PAGE_BYTES, LEAST_BYTES, MOST_IMAGES = 130_000, 30_000, 40
"""Bytes for scripts and styles, least bytes of the mesh, and number of camera images, in such a page."""
IMAGE_ADDRESS = "picture/"
"""Address of a served image, before the camera's number."""
DEPTH_ADDRESS = "depth/"
"""The same of a depth image."""


@dataclass(frozen=True, slots=True)
class ScenePage:
    """A scene as a single file."""

    html: str
    """The full page, which loads nothing else."""
    shown: str
    """Description of what it shows."""


def scene_page(scene: SpaceScene, most: int) -> ScenePage:
    """A self-contained page of a scene with at most `most` points per layer and at most `most` Gaussians.

    A textured mesh is reduced until the page has about 10 bytes times `most`, and points that are not visible initially
    are left out.
    """
    is_textured = isinstance(scene.mesh, TexturedMeshLayer)
    inside = None
    if scene.cameras is not None:
        inside = embedded_images(scene.cameras, *([MOST_IMAGES] if is_textured else []))
    shown = _smaller(scene, most, sum(map(len, filter(None, inside or [])))) if is_textured else scene
    data = space_data(shown, most, most)
    if inside is not None:
        data.numbers["cameras"]["images"] = inside if any(inside) else None
    words = _with_what_is_left_out(scene, data)
    return ScenePage(_html(scene, data, words, data.blocks), words)


def _smaller(scene: SpaceScene, most: int, image_bytes: int) -> SpaceScene:
    """A scene with a textured mesh whose page has about 10 bytes times `most`, if it can be."""
    points = tuple(layer for layer in scene.points if layer.is_shown)
    num_points = sum(min(len(layer.xyz_in_world), most) for layer in points)
    left = BYTES_PER_ITEM * most - PAGE_BYTES - image_bytes - 22 * num_points
    assert isinstance(scene.mesh, TexturedMeshLayer)
    return replace(scene, points=points, mesh=reduced(scene.mesh, max(LEAST_BYTES, 3 * left // 4)))


def served_page(scene: SpaceScene, live: dict[str, Any] | None = None) -> tuple[str, SpaceData]:
    """A page for a server that has the bytes at `data/NAME`, and images below `IMAGE_ADDRESS` and `DEPTH_ADDRESS`.

    Args:
        scene: the scene.
        live: settings for the script of a live page; None: the scene is finished.
    """
    data = space_data(scene)
    data.numbers["live"] = live
    if scene.cameras is not None:
        of_cameras, numbers = data.numbers["cameras"], range(len(scene.cameras.names))
        if scene.cameras.load_image is not None:
            of_cameras["images"] = [f"{IMAGE_ADDRESS}{k}" for k in numbers]
        if scene.cameras.load_depth is not None:
            of_cameras["depths"] = [f"{DEPTH_ADDRESS}{k}" for k in numbers]
    return _html(scene, data, scene.words, {}, served=True), data


def _html(scene: SpaceScene, data: SpaceData, words: str, blocks: dict[str, bytes], **flags: bool) -> str:
    return render(
        __package__,
        "scene.html.jinja",
        title=scene.title,
        words=words,
        lengths=lengths_in_words(scene.unit),
        data=data,
        blocks=blocks,
        **flags,
    )


def lengths_in_words(unit: str) -> str:
    """A sentence about the unit of lengths."""
    if unit == NO_UNIT:
        return "Lengths are known up to scale"
    return f"Lengths are in {'meters' if unit == METERS else unit}"


def _with_what_is_left_out(scene: SpaceScene, data: SpaceData) -> str:
    left = [
        f"{of_all(layer['count'], layer['whole'])} {layer['name'].lower()}"
        for layer in data.numbers["points"]
        if layer["count"] < layer["whole"]
    ]
    if isinstance(scene.mesh, TexturedMeshLayer):
        mesh = data.numbers["mesh"]
        if mesh["count"] < len(scene.mesh.faces):
            left.append(f"{of_all(mesh['count'], len(scene.mesh.faces))} triangles")
        left += [f"without the {layer.name.lower()}" for layer in scene.points if not layer.is_shown]
    gaussians = data.numbers["gaussians"]
    if gaussians is not None and gaussians["count"] < gaussians["whole"]:
        left.append(f"{count(gaussians['whole'])} Gaussians merged into {count(gaussians['count'])}")
    return f"{scene.words}; here {', '.join(left)}" if left else scene.words
