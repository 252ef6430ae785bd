"""Mapping of many images in parts: overlapping parts of the view graph are mapped separately, joined, and adjusted together.

A part needs memory for its own images, and parts can be mapped at the same time, on other machines too. They are joined by the points
that they have in common (`joining.py`), like finished models; the images of a part that does not fit are registered one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64

from epipole.geometry import Rigid3
from epipole.mapping import ModelBuilder, connect_matches, connected_images, divide_images, nearest_outside
from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.mappers.choice import map_with
from epipole.pipelines.sfm.mappers.growth import LEAST_IMAGES, Start, grow_model
from epipole.pipelines.sfm.mappers.incremental import IncrementalMapper, Progress, ignore_progress
from epipole.scene import Cameras, ViewGraph

OVERLAP = 0.1
"""Images of the neighboring parts that a part also has, relative to its own."""
LEAST_OVERLAP = 20


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Images that are mapped together."""

    images: Int64[np.ndarray, " n"]
    """Their rows among all images."""
    view_graph: ViewGraph
    """The pairs between them, numbered within the part."""
    keypoints: tuple[np.ndarray, ...]
    cameras: Cameras
    """Those of all images."""
    camera_of_image: Int32[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, eq=False)
class MappedPart:
    """The poses of a part's largest model."""

    images: Int64[np.ndarray, " n"]
    """Rows of the registered images among all images."""
    cams_from_world: Rigid3
    params: Float64[np.ndarray, "c 12"]
    """Refined intrinsics of all cameras."""


MapParts = Callable[[Iterable[Part]], Sequence[MappedPart]]
"""Maps parts in any order, here or elsewhere."""


def map_divided(
    mapper: IncrementalMapper,
    usable: Bool[np.ndarray, " n"],
    map_parts: MapParts | None = None,
    progress: Progress = ignore_progress,
) -> bool:
    """Map the most usable images that matches connect, in parts of `part_images` and an overlap; False if no part has a model.

    Args:
        mapper: an incremental mapper, which has the model, the pairs and the options.
        usable: mask of images.
        map_parts: maps the parts; None: one after the other, in this thread.
        progress: called with the number of registered and of usable images.
    """
    parts = divided(mapper, usable)
    found = map_parts(parts) if map_parts is not None else [map_part(part, mapper.config) for part in parts]
    starts = [_start_of(one, mapper.model) for one in found if len(one.images) >= LEAST_IMAGES]
    starts.sort(key=lambda start: -len(start.cams_from_world))
    if len(starts) < len(found):
        mapper.notes.append(f"{len(found) - len(starts)} of {len(found)} parts of the images gave no model")
    if starts and grow_model(mapper, starts, usable, progress):
        apart = [count for count in mapper.num_apart if count]
        if apart:
            mapper.notes.append(
                f"{len(apart)} of {len(found)} parts have too few points in common with the others: their {sum(apart)} images were"
                " registered one by one, if they could be"
            )
        return True
    mapper.notes.append(
        "the parts do not fit each other, so all images were mapped together, which needs more memory"
    )
    return False


def divided(mapper: IncrementalMapper, usable: Bool[np.ndarray, " n"]) -> Iterator[Part]:
    """Overlapping parts of the largest connected component of the usable images; each has a copy of its matches."""
    graph, model = mapper.view_graph, mapper.model
    graph = graph.select(usable[graph.image1] & usable[graph.image2] & (graph.num_inliers() > 0))
    component = connected_images(len(usable), graph.image1, graph.image2)
    graph = graph.select(component[graph.image1] == np.argmax(np.bincount(component, usable)))
    pairs = graph.image1, graph.image2, graph.num_inliers().astype(np.float64)
    for own in divide_images(len(usable), *pairs, mapper.config.part_images):
        most = max(LEAST_OVERLAP, int(OVERLAP * len(own)))
        images = np.sort(np.concatenate([own, nearest_outside(own, len(usable), *pairs, most)]))
        yield _part_of(images, graph, model)


def _part_of(images: np.ndarray, graph: ViewGraph, model: ModelBuilder) -> Part:
    number = np.full(len(model.keypoints), -1, np.int32)
    number[images] = np.arange(len(images))
    inside = graph.select((number[graph.image1] >= 0) & (number[graph.image2] >= 0))
    return Part(
        images,
        replace(inside, image1=number[inside.image1], image2=number[inside.image2]),
        tuple(model.keypoints[k] for k in images),
        model.cameras,
        model.camera_of_image[images],
    )


def map_part(part: Part, config: MapperConfig) -> MappedPart:
    """Map the images of a part."""
    starts = np.concatenate([[0], np.cumsum([len(k) for k in part.keypoints])]).astype(np.int64)
    components = connect_matches(part.view_graph, starts)
    model = ModelBuilder(part.cameras, part.camera_of_image, part.keypoints, components)
    mapper = IncrementalMapper(model, part.view_graph, config, is_last=False)
    is_mapped = map_with(mapper, np.ones(len(part.images), bool)) is not None
    registered = np.flatnonzero(model.registered) if is_mapped else np.zeros(0, np.int64)
    motion = model.motion[registered]
    poses = Rigid3(motion[:, :9].reshape(-1, 3, 3), motion[:, 9:])
    return MappedPart(part.images[registered], poses, model.params.copy())


def _start_of(found: MappedPart, model: ModelBuilder) -> Start:
    cameras = replace(model.cameras, params=found.params)
    used = np.unique(model.camera_of_image[found.images]).tolist()
    poses = {row: found.cams_from_world[k] for k, row in enumerate(found.images.tolist())}
    return Start(poses, {camera: cameras[camera] for camera in used})
