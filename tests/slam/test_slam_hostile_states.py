"""States and maps that others have made, with a digest that fits: refused before a kernel reads them."""

import json
from functools import cache

import numpy as np
import pytest
from slam_rides import STEREO, ride

from epipole.errors import FileFormatError
from epipole.pipelines.slam.checkpoint import known_to
from epipole.pipelines.slam.map_files import TABLE, VERSION, read_slam_map, sketch_of_map, write_slam_map
from epipole.pipelines.slam.restoring import read_state
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.state_files import ARRAYS, STATE, StateFiles
from epipole.runs.units import load, store


@cache
def tracked():
    """After three frames of a pair of cameras."""
    system = Slam(STEREO)
    for frame in ride("arc", 3).frames("stereo"):
        system.track(frame)
    return system


@cache
def state_bytes(folder):
    files = StateFiles(folder)
    files.write(vars(tracked()), known_to(tracked()), {"num_lines": 3, "num_bytes": 9})
    files.close()
    with np.load(folder / STATE) as held:
        return {name: held[name] for name in ("text", "inline")}


def restored(folder, change):
    """What comes of a state whose text was changed, and which was sealed again."""
    held = state_bytes(folder)
    content = json.loads(held["text"].tobytes())
    change(content)
    text = np.frombuffer(json.dumps(content).encode(), np.uint8)
    store(folder / STATE, "epipole checkpoint 2", {"text": text, "inline": held["inline"]})
    return read_state(Slam(STEREO), StateFiles(folder))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("state")


def attributes(content, kind):
    """Of the first object of a kind."""

    def search(code):
        if isinstance(code, list):
            if len(code) == 3 and code[0] == "object" and code[1] == kind:
                return code[2]
            return next(filter(None, map(search, code)), None)
        return next(filter(None, map(search, code.values())), None) if isinstance(code, dict) else None

    return search(content["structure"])


def test_a_state_is_restored(folder):
    assert restored(folder, lambda content: None).num_lines == 3


@pytest.mark.parametrize(
    ("kind", "name", "code"),
    [
        ("SlamMap", "num_points", 10**6),
        ("SlamMap", "right_shift_px", "far"),
        ("SlamMap", "keyframes", ["list", 1, 2]),
        ("SlamMap", "motion", ["array", 0]),
        ("Keyframe", "shift_px", ["array", 0]),
        ("Keyframe", "point", ["array", 0]),
        ("Keyframe", "covariance", None),
        ("Keyframe", "unit", 0.0),
        ("Tracks", "start_px", ["array", 0]),
        ("Path", "_open", ["array", 0]),
        ("Path", "first", -(10**12)),
        ("MapTracker", "config", ["known", "lens"]),
        ("MapTracker", "stale", ["list"]),
        ("OneCameraStart", "_num_at_start", 10**12),
        ("Frame", "right_grey", None),
        ("Rigid3", "rotation", ["array", 0]),
    ],
)
def test_attributes_of_another_kind_are_refused(kind, name, code, folder):
    def change(content):
        attributes(content, kind)[name] = code

    with pytest.raises(FileFormatError, match=r"state\.npz: is damaged"):
        restored(folder, change)


def test_attributes_that_are_not_there_are_refused(folder):
    for change in (
        lambda content: attributes(content, "Keyframe").pop("look"),
        lambda content: attributes(content, "Keyframe").update(__class__=["known", "lens"]),
        lambda content: attributes(content, "Keyframe").update(keep=1),
    ):
        with pytest.raises(FileFormatError, match="attributes"):
            restored(folder, change)


def test_arrays_are_no_larger_than_their_files(folder):
    def repeat(content):
        content["arrays"] *= 1000

    with pytest.raises(FileFormatError, match="larger than their files"):
        restored(folder, repeat)
    assert (folder / ARRAYS.format(0)).is_file()


def at(name, where, value):
    def change(arrays):
        arrays[name][where] = value

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (at("point", 0, 10**6), "point must be within"),
        (at("point", 0, -1), "point must be within"),
        (at("anchor", 0, 99), "anchor must be within"),
        (at("offsets", 1, 10**9), "offsets must rise"),
        (at("pixels", (0, 0), 1e9), "within the picture"),
        (at("rotation", (0, 0, 0), 2.0), "rotation matrices"),
        (at("camera_model", (), 99), "no map's"),
        (lambda arrays: arrays.pop("grey"), "'grey' is missing"),
        (lambda arrays: arrays.update(grey=arrays["grey"].astype(np.float32)), "grey must be"),
        (lambda arrays: arrays.update(camera_params=np.ones(1)), "no map's"),
        (lambda arrays: arrays.update(point=arrays["point"].astype(np.float64)), "point must be"),
        (lambda arrays: arrays.update(other=np.ones(1)), "not known"),
    ],
)
def test_maps_whose_arrays_do_not_fit_are_refused(change, words, tmp_path):
    names = [f"{n}.png" for n in range(len(tracked().map.keyframes))]
    write_slam_map(tmp_path / "map.npz", tracked().map, names, STEREO)
    arrays = {name: np.array(part) for name, part in load(tmp_path / "map.npz", TABLE).items()}
    change(arrays)
    store(tmp_path / "map.npz", VERSION, arrays)
    for read in (lambda path: read_slam_map(path, STEREO), sketch_of_map):
        with pytest.raises(FileFormatError, match=words):
            read(tmp_path / "map.npz")
