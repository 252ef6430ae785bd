"""Stage that maps parts of many images, as units of work: in threads, in processes, or on the machines of a cluster."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from epipole._checks.tables import Arrays, Expected, Table
from epipole.errors import EpipoleError, WorkspaceError
from epipole.geometry import Rigid3
from epipole.mapping.match_components import check_matches
from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.mappers.divided import MapParts, MappedPart, Part, map_part
from epipole.pipelines.sfm.matching.unit_tables import GEOMETRIES
from epipole.runs import Run, Unit, digest, is_done, load, store
from epipole.scene import Cameras, ViewGraph

FORMAT = 1
"""Changes with the contents of the files and with the mappers' results."""
PART: Table = {
    **{name: entry for name, entry in GEOMETRIES.items() if name != "pair_keys"},
    "image1": Expected("int32", "p", least=0, below="n"),
    "image2": Expected("int32", "p", least=0, below="n"),
    "keypoint_offsets": Expected("int64", "n+1", rises_to="k"),
    "keypoints": Expected("float64", "k 2"),
    "camera_of_image": Expected("int32", "n", least=0, below="c"),
    "model": Expected("int32", "c"),
    "width": Expected("int32", "c", least=1),
    "height": Expected("int32", "c", least=1),
    "params": Expected("float64", "c 12"),
    "is_focal_trusted": Expected("bool", "c"),
    "is_constant": Expected("bool", "c"),
}
POSES: Table = {
    "image": Expected("int64", "r", least=0, below="n"),
    "rotation": Expected("float64", "r 3 3", is_rotation=True),
    "translation": Expected("float64", "r 3"),
    "params": Expected("float64", "c 12"),
}


@dataclass(frozen=True, slots=True, eq=False)
class PartTask:
    """A part in a file, and how to map it."""

    file: Path
    config: MapperConfig


def in_units(run: Run, folder: Path, config: MapperConfig) -> MapParts:
    """Maps parts as units of work of a run, each with a file in `folder`; the parts themselves are written to files meanwhile."""

    def map_parts(parts: Iterable[Part]) -> list[MappedPart]:
        inputs = folder.with_name(f"{folder.name}-input")
        units, images_of = [], []
        for n, part in enumerate(parts):  # one at a time: each has a copy of its matches
            arrays, name = arrays_of_part(part), f"{n:05d}.npz"
            key = digest("map", FORMAT, asdict(config), *(arrays[name] for name in sorted(arrays)))
            task = PartTask(inputs / name, config)
            units.append(Unit(folder / name, key, map_part_in_file, task, size=len(part.images)))
            images_of.append(part.images)
            if not is_done(units[-1].path, key):
                store(task.file, key, arrays)
        run.do(units, "parts")
        shutil.rmtree(inputs, ignore_errors=True)
        return [_poses_in(unit.path, images) for unit, images in zip(units, images_of)]

    return map_parts


def map_part_in_file(task: PartTask) -> Arrays:
    """Map a part; the arrays of `POSES`."""
    found = map_part(load_part(task.file), task.config)
    return {
        "image": found.images,
        "rotation": found.cams_from_world.rotation,
        "translation": found.cams_from_world.translation,
        "params": found.params,
    }


def _poses_in(path: Path, images: np.ndarray) -> MappedPart:
    """Read the poses of a part with these images.

    Raises:
        WorkspaceError: the file is damaged.
    """
    found = load(path, POSES, n=len(images))
    poses = Rigid3(found["rotation"], found["translation"])
    return MappedPart(images[found["image"]], poses, found["params"])


def arrays_of_part(part: Part) -> Arrays:
    """The arrays of `PART`."""
    graph, cameras = part.view_graph, part.cameras
    return {
        "image1": graph.image1,
        "image2": graph.image2,
        "kind": graph.kind,
        "num_putative": graph.num_putative,
        "offsets": graph.match_offsets,
        "matches": np.stack([graph.keypoint1, graph.keypoint2], axis=1),
        "rotation": graph.cam2_from_cam1.rotation,
        "translation": graph.cam2_from_cam1.translation,
        "essential": graph.essential,
        "fundamental": graph.fundamental,
        "homography": graph.homography,
        "median_angle_rad": graph.median_angle_rad,
        "keypoint_offsets": np.concatenate([[0], np.cumsum([len(k) for k in part.keypoints])]).astype(
            np.int64
        ),
        "keypoints": np.concatenate([np.zeros((0, 2)), *part.keypoints]),
        "camera_of_image": part.camera_of_image,
        **{name: getattr(cameras, name) for name in Cameras.__slots__},
    }


def load_part(path: Path) -> Part:
    """Read a part.

    Raises:
        WorkspaceError: the file is missing or damaged.
    """
    found = load(path, PART)
    ends = found["keypoint_offsets"]
    try:
        cameras = Cameras(**{name: found[name] for name in Cameras.__slots__})
        Cameras.from_list(cameras[row] for row in range(len(cameras)))  # checks each of them
        graph = _view_graph_of(found)
        check_matches(graph, np.diff(ends))
    except EpipoleError as error:
        raise WorkspaceError(f"{path} is damaged ({error}); delete it and run the command again") from error
    keypoints = tuple(found["keypoints"][start:end] for start, end in pairwise(ends))
    return Part(np.arange(len(keypoints)), graph, keypoints, cameras, found["camera_of_image"])


def _view_graph_of(found: Arrays) -> ViewGraph:
    return ViewGraph(
        found["image1"],
        found["image2"],
        found["kind"],
        found["num_putative"],
        found["offsets"],
        found["matches"][:, 0].copy(),
        found["matches"][:, 1].copy(),
        Rigid3(found["rotation"], found["translation"]),
        found["essential"],
        found["fundamental"],
        found["homography"],
        found["median_angle_rad"],
    )
