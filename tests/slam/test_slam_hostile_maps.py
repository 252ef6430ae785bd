"""Maps that others have made, with a digest that fits: refused before a kernel reads them."""

from functools import cache

import numpy as np
import pytest
from slam_rides import STEREO, ride

from epipole.errors import FileFormatError
from epipole.pipelines.slam.output.map_file import (
    TABLE,
    VERSION,
    read_slam_map,
    summary_of_map,
    write_slam_map,
)
from epipole.pipelines.slam.slam import Slam
from epipole.runs.units import load, store


@cache
def tracked():
    """After three frames of a pair of cameras."""
    system = Slam(STEREO)
    for frame in ride("arc", 3).frames("stereo"):
        system.track(frame)
    return system


def at(name, where, value):
    def change(arrays):
        arrays[name][where] = value

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (at("point", 0, 10**6), "point must be from"),
        (at("point", 0, -1), "point must be from"),
        (at("anchor", 0, 99), "anchor must be from"),
        (at("offsets", 1, 10**9), "offsets must increase"),
        (at("pixels", (0, 0), 1e9), "inside the image"),
        (at("rotation", (0, 0, 0), 2.0), "rotation matrices"),
        (at("camera_model", (), 99), "not those of a map"),
        (lambda arrays: arrays.pop("grey"), "'grey' is missing"),
        (lambda arrays: arrays.update(grey=arrays["grey"].astype(np.float32)), "grey must be"),
        (lambda arrays: arrays.update(camera_params=np.ones(1)), "not those of a map"),
        (lambda arrays: arrays.update(point=arrays["point"].astype(np.float64)), "point must be"),
        (lambda arrays: arrays.update(other=np.ones(1)), "is unknown"),
    ],
)
def test_maps_whose_arrays_do_not_fit_are_refused(change, words, tmp_path):
    names = [f"{n}.png" for n in range(len(tracked().map.keyframes))]
    write_slam_map(tmp_path / "map.npz", tracked().map, names, STEREO)
    arrays = {name: np.array(part) for name, part in load(tmp_path / "map.npz", TABLE).items()}
    change(arrays)
    store(tmp_path / "map.npz", VERSION, arrays)
    for read in (lambda path: read_slam_map(path, STEREO), summary_of_map):
        with pytest.raises(FileFormatError, match=words):
            read(tmp_path / "map.npz")
