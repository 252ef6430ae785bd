"""The package as one who imports it sees it: names, options by keyword, and what is printed."""

import inspect
from pathlib import Path

import numpy as np
import pytest

import epipole
from epipole.cameras import Camera
from epipole.config import options_of
from epipole.errors import ConfigError, EpipoleError
from epipole.geometry import decompose_homography
from epipole.io import PlyPoints, TruthCameras
from epipole.io.calibration.files import CalibrationFile
from epipole.optim import PoseGraph
from epipole.pipelines.stereo.doctor import examine
from epipole.robust import PairMatches, verify_pairs
from epipole.scene import depth_map_to_point_cloud, extent_of
from epipole.synthetic.problems import two_view_problem

CONFIGS = (
    "Reconstruct",
    "Feature",
    "Match",
    "Pairing",
    "Ransac",
    "Mapper",
    "Slam",
    "Stereo",
    "Calibration",
    "Board",
)


def test_every_config_and_what_configs_are_made_of_is_there() -> None:
    seen = dir(epipole)
    for name in (*(f"{c}Config" for c in CONFIGS), "Camera", "CameraModel", "RectifiedRig", "StereoRig"):
        assert name in seen and inspect.isclass(getattr(epipole, name)), name
    assert all(name in seen for name in ("reconstruct", "stereo", "geometry", "__version__"))
    nested = {type(value).__name__ for value in vars(epipole.ReconstructConfig()).values()}
    assert {n for n in nested if n.endswith("Config")} <= set(seen)


def test_options_by_name_override_those_of_the_config() -> None:
    given = epipole.ReconstructConfig(threads=3, single_camera=False)
    found = options_of(epipole.ReconstructConfig, given, {"single_camera": True, "max_features": 10})
    assert (found.threads, found.single_camera, found.features.max_features) == (3, True, 10)
    assert not given.single_camera and given.features.max_features != 10
    assert options_of(epipole.ReconstructConfig, given) is given
    board = options_of(epipole.CalibrationConfig, None, {"columns": 7, "rows": 5}).board
    assert (board.columns, board.rows) == (7, 5)


def test_options_that_need_each_other_may_be_given_by_name() -> None:
    both = {"board": "9x6", "square_m": 0.1}
    for kind in (epipole.ReconstructConfig, epipole.JobOptions):
        anchors = options_of(kind, None, both).anchors
        assert (anchors.board, anchors.square_m) == ("9x6", 0.1)
    with pytest.raises(epipole.errors.ConfigError, match="needs both"):
        options_of(epipole.JobOptions, None, {"board": "9x6"})


@pytest.mark.parametrize("order", [1, -1])
def test_a_whole_config_and_one_of_its_parts_in_any_order(order: int) -> None:
    names = {"max_features": 10, "features": epipole.FeatureConfig(max_size_px=99)}
    found = options_of(epipole.ReconstructConfig, None, dict(list(names.items())[::order]))
    assert (found.features.max_features, found.features.max_size_px) == (10, 99)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"single_cam": True}, r"no option single_cam; did you mean single_camera\?"),
        ({"max_feature": 1}, r"did you mean max_features"),
        ({"xyzzy": 1}, r"ReconstructConfig has no option xyzzy; it has camera_model, "),
        (
            {"seed": 1},
            r"seed is an option of verification and of mapper: .* mapper=MapperConfig\(seed=\.\.\.\)",
        ),
        ({"max_features": 0}, "max_features must be at least 1"),
        ({"threads": "4"}, "wrong type, threads='4'"),
        ({"features": {"max_features": 3}}, r"FeatureConfig\(\*\*it\) makes one"),
    ],
)
def test_options_that_cannot_be(options: dict, words: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=words):
        epipole.reconstruct(tmp_path, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_every_verb_with_options_takes_them_by_name(tmp_path: Path) -> None:
    """Each says which option is unknown before it looks for its files."""
    no = tmp_path / "no"
    for call in (
        lambda: epipole.reconstruct(no, no, nosuch=1),
        lambda: epipole.stereo(no, no, no, nosuch=1),
        lambda: epipole.stereo_many(no, no, no, nosuch=1),
        lambda: epipole.stereo_of_model(no, "a", "b", no, nosuch=1),
        lambda: epipole.calibrate(no, no, nosuch=1),
    ):
        with pytest.raises(ConfigError, match="has no option nosuch"):
            call()
    with pytest.raises(EpipoleError, match="columns and rows, got 2 x 6"):
        epipole.calibrate(no, no, columns=2)
    with pytest.raises(EpipoleError, match="does not exist"):
        epipole.reconstruct(no, no, single_camera=True)


def printed_things() -> list[object]:
    rng = np.random.default_rng(1)
    pair = two_view_problem(200, seed=1)
    camera = Camera("PINHOLE", 640, 480, [500, 500, 319.5, 239.5])
    matches = PairMatches(pair.pixels1, pair.pixels2, pair.camera1, pair.camera2)
    two = epipole.Rigid3.identity(2)
    flat = np.full((40, 50), 90, np.uint8)
    return [
        camera,
        *(two, two[0]),
        *(matches, *verify_pairs([matches])),
        decompose_homography(np.eye(3) + 0.01 * rng.normal(size=(3, 3)), np.eye(3), np.eye(3)),
        depth_map_to_point_cloud(np.ones((40, 50)), camera.K),
        extent_of(rng.normal(size=(2000, 3)), rng.normal(size=(9, 3)), 90.0),
        PlyPoints(rng.normal(size=(2000, 3)), None),
        TruthCameras(tuple(map(str, range(900))), epipole.Rigid3.identity(900)),
        CalibrationFile((camera, camera), two, np.eye(30)),
        PoseGraph(two, np.array([0]), np.array([1]), two[:1], np.eye(6)[None]),
        examine([(flat, flat)]),
    ]


def test_what_is_printed_is_one_short_line_without_arrays() -> None:
    for thing in printed_things():
        words = repr(thing)
        assert words.startswith(f"{type(thing).__name__}(") and "\n" not in words
        assert len(words) < 260 and "array" not in words and "..." not in words, words
