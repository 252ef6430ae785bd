"""Units of SfM that others have made, with a digest that fits: what they hold is checked where it is read."""

from pathlib import Path

import numpy as np
import pytest

from epipole.errors import WorkspaceError
from epipole.pipelines.sfm.matching.feature_stage import load_features
from epipole.pipelines.sfm.matching.match_stage import load_putative, load_view_graph
from epipole.pipelines.sfm.matching.pair_blocks import PairBlock, filled
from epipole.pipelines.sfm.matching.unit_tables import GEOMETRIES, MATCHES
from epipole.runs.units import Unit, store

COUNTS = [6, 5, 4]


def features():
    found = {"pixels": np.arange(12, dtype=np.float32).reshape(6, 2), "scale_px": np.ones(6, np.float32)}
    found |= {"angle_rad": np.ones(6, np.float32), "descriptors": np.ones((6, 128), np.uint8)}
    found |= {"colors": np.zeros((6, 3), np.uint8), "thumbnail": np.zeros(9, np.uint8)}
    return found | {"failure": np.array("")}


def matches():
    rows = np.array([[0, 1], [2, 3]], np.int32)
    return filled(block(MATCHES), lambda positions: [{"matches": rows}] * len(positions))


def geometries():
    one = {"matches": np.array([[0, 1], [2, 3]], np.int32), "median_angle_rad": np.array(0.1)}
    one |= {"kind": np.array(1, np.int32), "num_putative": np.array(3, np.int32), "translation": np.ones(3)}
    one |= {name: np.eye(3) for name in ("rotation", "essential", "fundamental", "homography")}
    return filled(block(GEOMETRIES), lambda positions: [one] * len(positions))


def block(table):
    return PairBlock(((0, 1), (1, 2)), ("a", "b"), {}, table, None)


def put(path: Path, arrays, change):
    change(arrays)
    store(path, "key", arrays)
    return path


def use_putative(path):
    return load_putative([Unit(path, "key", features, block(MATCHES))], COUNTS)


def use_graph(path):
    return load_view_graph([Unit(path, "key", features, block(GEOMETRIES))], COUNTS)


USES = {
    "features": (features, load_features),
    "matches": (matches, use_putative),
    "geometries": (geometries, use_graph),
}


@pytest.mark.parametrize("what", list(USES))
def test_what_is_whole_is_read(what, tmp_path):
    make, use = USES[what]
    assert use(put(tmp_path / "a.npz", make(), lambda arrays: None)) is not None


def at(name, where, value):
    def change(arrays):
        arrays[name] = arrays[name].copy()
        arrays[name][where] = value

    return change


@pytest.mark.parametrize(
    ("what", "change"),
    [
        ("features", lambda arrays: arrays.pop("scale_px")),
        ("features", lambda arrays: arrays.update(pixels=arrays["pixels"][:3])),
        ("features", lambda arrays: arrays.update(descriptors=arrays["descriptors"].astype(np.float32))),
        ("features", at("pixels", (0, 0), np.nan)),
        ("matches", at("matches", (0, 0), 6)),
        ("matches", at("matches", (0, 1), -1)),
        ("matches", at("matches", (3, 1), 4)),
        ("matches", at("offsets", 1, 10**9)),
        ("matches", lambda arrays: arrays.update(offsets=arrays["offsets"][:2])),
        ("geometries", at("matches", (2, 0), 5)),
        ("geometries", at("kind", 0, 77)),
        ("geometries", at("rotation", (0, 0, 0), 3.0)),
        ("geometries", lambda arrays: arrays.pop("homography")),
        ("geometries", lambda arrays: arrays.update(kind=arrays["kind"][:1])),
    ],
)
def test_arrays_that_do_not_fit_are_refused(what, change, tmp_path):
    make, use = USES[what]
    path = put(tmp_path / "a.npz", make(), change)
    with pytest.raises(WorkspaceError, match="delete it and run the command again"):
        use(path)
