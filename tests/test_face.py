"""The package as one who imports it sees it: names, options by keyword, and what is printed."""

import ast
import inspect
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import is_dataclass
from enum import Enum
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest
from tests import option_types

import epipole
from epipole.cameras import Camera
from epipole.config import options_of
from epipole.errors import ConfigError, EpipoleError
from epipole.geometry import decompose_homography
from epipole.io import PlyPoints, TruthCameras
from epipole.io.calibration.files import CalibrationFile
from epipole.optim import PoseGraph
from epipole.pipelines.stereo.doctor import examine
from epipole.pipelines.stereo.run import stereo_many, stereo_of_model
from epipole.robust import PairMatches, verify_pairs
from epipole.scene import depth_map_to_point_cloud, extent_of
from epipole.synthetic.problems import two_view_problem
from whole import in_whole_run

MOST_NAMES = 80


def test_the_list_is_short_and_every_name_is_there() -> None:
    names = [name for name in dir(epipole) if name != "__version__"]
    assert 50 < len(names) <= MOST_NAMES
    assert all(getattr(epipole, name) is not None for name in names)
    assert not [name for name in names if inspect.ismodule(getattr(epipole, name))]
    assert set(epipole.__all__) == {*names, "__version__"}
    assert epipole.geometry.Rigid3 is epipole.Rigid3  # packages are there, too, but are not listed
    with pytest.raises(AttributeError, match="no attribute 'nosuch'"):
        _ = epipole.nosuch


def own_classes(kind: object) -> set[type]:
    """Classes of the package that an annotation names, those inside unions, sequences and callables too."""
    found = {kind} if inspect.isclass(kind) and kind.__module__.startswith("epipole") else set()
    inner = get_args(kind)
    flat = [each for one in inner for each in (one if isinstance(one, list) else [one])]
    return found.union(*(own_classes(each) for each in flat)) if flat else found


RESULTS = ("Result", "Run", "Evaluation", "Frame", "Conversion", "StereoResult")
"""Ends of the names of classes that jobs give back, and users do not make."""


def signatures() -> Iterator[tuple[str, object]]:
    """Of every public function, and every constructor that users call, the annotations with the function's name."""
    for name in dir(epipole):
        thing = getattr(epipole, name)
        if inspect.isclass(thing):
            if name.endswith(RESULTS) and name != "Frame":
                continue
            has_fields = is_dataclass(thing) and "__init__" not in vars(thing).get("__annotations__", {})
            hints = {} if issubclass(thing, Enum) else get_type_hints(thing if has_fields else thing.__init__)
        elif callable(thing):
            hints = get_type_hints(inspect.unwrap(thing))
        else:
            continue
        for parameter, kind in hints.items():
            if parameter != "options":  # typed keywords, which only name what configs have
                yield f"{name}({parameter})", kind


def test_every_class_of_a_signature_can_be_imported_from_the_package() -> None:
    public = {getattr(epipole, name) for name in dir(epipole)}
    parts = (
        "Reconstruction(",
        "SlamMap(",
        "Mesh(",
        "MountedImu(",
        "ReferenceModel(",
    )  # put together by functions, not by users
    wrong = [
        f"{where}: {kind.__name__}"
        for where, annotation in signatures()
        for kind in own_classes(annotation)
        if kind not in public and not where.startswith(parts)
    ]
    assert not wrong, "\n".join(wrong)


def test_the_typed_keywords_are_the_options_of_the_configs() -> None:
    assert (Path(epipole.__file__).parent / "py.typed").is_file()
    for pipeline in option_types.PIPELINES:
        written = option_types.path_of(pipeline).read_text(encoding="utf-8")
        wanted = option_types.source_of(pipeline)
        assert ast.dump(ast.parse(written)) == ast.dump(ast.parse(wanted)), "python -m tests.option_types"


@in_whole_run
def test_a_type_checker_sees_options_and_arrays(tmp_path: Path) -> None:
    file = tmp_path / "use.py"
    file.write_text(USE)
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path / "cache"), str(file)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    errors = [line.split(": ", 1)[1] for line in done.stdout.splitlines() if ": error:" in line]
    assert len(errors) == 2, done.stdout + done.stderr
    assert "tiem" in errors[0]
    assert "max_frames" in errors[1]
    notes = [line for line in done.stdout.splitlines() if "Revealed type" in line]
    assert "ndarray" in notes[0] and "GaussianCloud" in notes[1]


USE = """import epipole

epipole.splat("photos", "out", time="1m", sh_degree=2)
epipole.splat("photos", "out", tiem="1m")
epipole.slam("video.mp4", "out", max_frames="many")
camera = epipole.Camera.from_K([[500, 0, 320], [0, 500, 240], [0, 0, 1]], (640, 480))
reveal_type(camera.K)
reveal_type(epipole.splat("photos", "out").cloud)
"""


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
    for kind in (epipole.ReconstructConfig, epipole.SlamConfig):
        anchors = options_of(kind, None, both).anchors
        assert (anchors.board, anchors.square_m) == ("9x6", 0.1)
    with pytest.raises(epipole.errors.ConfigError, match="needs both"):
        options_of(epipole.SlamConfig, None, {"board": "9x6"})


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
            {"max_error_px": 1.0},
            r"max_error_px is an option of verification and of mapper: .* mapper=MapperConfig\(max_error_px=\.\.\.\)",
        ),
        ({"max_features": 0}, "max_features must be at least 1"),
        ({"threads": "4"}, "wrong type, threads='4'"),
        ({"features": {"max_features": 3}}, r"make one with FeatureConfig\(\*\*it\)"),
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
        lambda: stereo_many(no, no, no, nosuch=1),
        lambda: stereo_of_model(no, "a", "b", no, nosuch=1),
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
