"""Files of ours whose digest is made anew after the damage: what they hold meets the checks of contents, and then the work that goes on in them."""

import copy
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from fields_scenes import views as field_views
from fields_trainers import trainer_of
from sfm_units import COUNTS, features, geometries, matches, put, use_graph, use_putative
from slam_rides import STEREO, ride

from epipole.cameras import Camera
from epipole.features import Features
from epipole.pipelines.fields.checkpoints import CHECKPOINT, Checkpoint
from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.mappers.divided import Part, map_part
from epipole.pipelines.sfm.matching.feature_stage import load_features
from epipole.pipelines.sfm.part_stage import arrays_of_part, load_part
from epipole.pipelines.slam.frames import Frame, SlamCamera
from epipole.pipelines.slam.output.map_file import read_slam_map, summary_of_map, write_slam_map
from epipole.pipelines.slam.slam import Slam
from epipole.runs.contents import content_digests
from epipole.runs.units import store
from epipole.scene import Cameras

SMALL = Camera("PINHOLE", 160, 120, [130.0, 130.0, 79.5, 59.5])
SENSOR = SlamCamera(SMALL, STEREO.baseline)


def checkpoint_of(kind: str, folder: Path) -> Checkpoint:
    """Of a trainer that may be changed."""
    return Checkpoint(folder, {"kind": kind}, field_views()[:4], copy.deepcopy(trainer_of(kind)))


def put_checkpoint(kind: str) -> Callable[[Path], None]:
    """What a training that was stopped after two steps leaves."""

    def write(folder: Path) -> None:
        checkpoint = checkpoint_of(kind, folder)
        checkpoint._trainer.restore({name: part.copy() for name, part in trainer_of(kind).state().items()})
        for _ in range(2):
            checkpoint._trainer.step(0.1)
        checkpoint.save(1.5, [[0.5, 1.0, 0.1, 60.0]])

    return write


def go_on_training(kind: str) -> Callable[[Path], None]:
    """Restore it, and go on."""

    def read(folder: Path) -> None:
        checkpoint = checkpoint_of(kind, folder)
        seconds, curve = checkpoint.restore()
        assert seconds >= 0 and all(len(row) == 4 for row in curve)
        for progress in (0.2, 0.6):
            checkpoint._trainer.step(progress)

    return read


@cache
def frames() -> list[Frame]:
    """Small images of a ride."""
    out = []
    for n, frame in enumerate(ride("arc", 6).frames("stereo")):
        left, right = frame.gray[::2, ::2].copy(), frame.right_gray[::2, ::2].copy()
        out.append(Frame(0.1 * n, left, right))
    return out


def put_map(folder: Path) -> None:
    """Of a pair of cameras."""
    system = Slam(SENSOR)
    for frame in frames()[:4]:
        system.track(frame)
    names = [f"{n}.png" for n in range(len(system.map.keyframes))]
    write_slam_map(folder / "map.npz", system.map, names, system.camera)


def go_on_in_map(folder: Path) -> None:
    """Draw it, and track two frames in it."""
    summary_of_map(folder / "map.npz")
    known = read_slam_map(folder / "map.npz", SENSOR)
    system = Slam(SENSOR, known=known.model)
    for frame in frames()[4:]:
        system.track(frame)


def use_features(folder: Path) -> None:
    """Read them."""
    found = load_features(folder / "a.npz")
    assert isinstance(found, Features) and np.isfinite(found.pixels).all()


def use_matches(folder: Path) -> None:
    """Of two pairs of images."""
    for (first, second), rows in use_putative(folder / "a.npz").items():
        assert (rows >= 0).all() and (rows < [COUNTS[first], COUNTS[second]]).all()


def use_geometries(folder: Path) -> None:
    """Of two pairs of images."""
    found = use_graph(folder / "a.npz")
    assert (found.keypoint1 >= 0).all() and (found.keypoint1 < 6).all() and (found.keypoint2 < 5).all()


def put_part(folder: Path) -> None:
    """Three images, two pairs of which have matches."""
    graph = use_graph(put(folder / "pairs.npz", geometries()))
    keypoints = tuple(np.arange(2.0 * count).reshape(count, 2) for count in COUNTS)
    part = Part(np.arange(3), graph, keypoints, Cameras.from_list([SMALL]), np.zeros(3, np.int32))
    store(folder / "part.npz", "key", arrays_of_part(part))


def use_part(folder: Path) -> None:
    """Read and map it."""
    part = load_part(folder / "part.npz")
    assert len(map_part(part, MapperConfig()).images) <= len(part.images)


def put_contents(folder: Path) -> None:
    """Digests that are remembered."""
    (folder / "a.txt").write_text("a")
    content_digests([folder / "a.txt"], folder / "contents.npz")


def use_contents(folder: Path) -> None:
    """Ask for them again: what is remembered wrongly is found anew."""
    found = content_digests([folder / "a.txt"], folder / "contents.npz")
    assert all(isinstance(one, str) for one in found.values())


SEALED: dict[str, tuple[Callable[[Path], None], str, Callable[[Path], None], float]] = {
    **{
        f"checkpoint-{kind}": (put_checkpoint(kind), CHECKPOINT, go_on_training(kind), weight)
        for kind, weight in (("splat", 1.0), ("hash", 0.1), ("grid", 0.3))
    },
    "slam-map-going-on": (put_map, "map.npz", go_on_in_map, 0.7),
    "unit-features": (lambda folder: put(folder / "a.npz", features()), "a.npz", use_features, 1.0),
    "unit-matches": (lambda folder: put(folder / "a.npz", matches()), "a.npz", use_matches, 1.0),
    "unit-geometries": (lambda folder: put(folder / "a.npz", geometries()), "a.npz", use_geometries, 1.0),
    "unit-part": (put_part, "part.npz", use_part, 1.0),
    "contents": (put_contents, "contents.npz", use_contents, 0.5),
}
"""What writes the file, its name, what reads it and goes on, and its share of the cases."""
