"""Units of SfM: features of one image, matches and geometries of two pairs."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

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


def put(path: Path, arrays: Any, change: Callable[[Any], object] = lambda arrays: None) -> Path:
    change(arrays)
    store(path, "key", arrays)
    return path


def use_putative(path):
    return load_putative([Unit(path, "key", features, block(MATCHES))], COUNTS)


def use_graph(path):
    return load_view_graph([Unit(path, "key", features, block(GEOMETRIES))], COUNTS)
