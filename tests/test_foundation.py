"""What everything stands on: errors, options, and the run-time type checks of this test run."""

import dataclasses
import pickle
import typing
from pathlib import Path

import numpy as np
import pytest

import epipole
from epipole import config, errors
from epipole.config import FeatureConfig, MatchConfig, RansacConfig, options_of
from epipole.errors import ConfigError, EpipoleError, FileFormatError
from epipole.geometry import Rigid3
from epipole.pipelines.sfm.config import MapperConfig, ReconstructConfig
from epipole.pipelines.stereo.config import StereoConfig
from epipole.robust.estimate import random_order

OPTIONS = [c for c in vars(config).values() if dataclasses.is_dataclass(c)]


@pytest.mark.parametrize(
    ("name", "builtin"),
    [
        ("ShapeError", ValueError),
        ("ConfigError", ValueError),
        ("DegenerateGeometryError", ValueError),
        ("WorkspaceError", OSError),
        ("NoModelError", RuntimeError),
        ("MissingDependencyError", ImportError),
    ],
)
def test_errors_are_caught_as_ours_and_as_their_builtin_kind(name: str, builtin: type[Exception]) -> None:
    error = getattr(errors, name)
    for kind in (EpipoleError, builtin):
        with pytest.raises(kind, match=r"^what went wrong$"):
            raise error("what went wrong")


def test_a_bad_file_is_named() -> None:
    for path in ("scans/a.ply", Path("scans/a.ply")):
        error = FileFormatError(path, "line 3: not a number")
        assert isinstance(error, EpipoleError) and isinstance(error, ValueError)
        assert str(error) == f"{Path('scans/a.ply')}: line 3: not a number"
        assert error.path == Path("scans/a.ply")


@pytest.mark.parametrize("options", OPTIONS, ids=lambda c: c.__name__)
def test_options_have_defaults_and_stay_as_they_are(options: type) -> None:
    made = options()
    assert dataclasses.replace(made) == made
    for field in dataclasses.fields(made):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(made, field.name, None)
    with pytest.raises(TypeError):
        options(1)  # by name only: positions would change with each new option


@pytest.mark.parametrize("options", OPTIONS, ids=lambda c: c.__name__)
def test_defaults_are_among_the_choices(options: type) -> None:
    made, hints = options(), typing.get_type_hints(options)
    for name, hint in hints.items():
        if typing.get_origin(hint) is typing.Literal:
            assert getattr(made, name) in typing.get_args(hint), name


@pytest.mark.parametrize(
    ("options", "name", "bad", "good"),
    [
        (FeatureConfig, "max_features", [0, -5], [1]),
        (FeatureConfig, "max_size_px", [0, 15], [16]),
        (MatchConfig, "max_ratio", [0.0, -0.1, 1.01, np.nan], [1e-3, 1.0]),
        (MatchConfig, "preemptive_features", [-1], [0]),
        (RansacConfig, "max_error_px", [0.0, -4.0, np.nan], [1e-6]),
        (RansacConfig, "confidence", [0.0, 1.0, 1.5, np.nan], [0.5]),
        (MapperConfig, "max_error_px", [0.0, np.nan], [0.1]),
        (MapperConfig, "resection_max_error_px", [0.0, -1.0], [0.1]),
        (MapperConfig, "gps_sigma_m", [0.0, -1.0], [0.1]),
        (MapperConfig, "global_growth", [1.0, 0.5], [1.01]),
        (ReconstructConfig, "threads", [0, -1], [1, None]),
    ],
)
def test_values_that_make_no_sense_are_refused(options: type, name: str, bad: list, good: list) -> None:
    for value in bad:
        with pytest.raises(ConfigError):
            options(**{name: value})
    for value in good:
        assert getattr(options(**{name: value}), name) == value


@pytest.mark.parametrize("text", ["500,320,240", "500, 320, 240", "5e2 320 240.0"])
def test_known_intrinsics_are_read(text: str) -> None:
    assert ReconstructConfig(camera_params=text).known_params() == (500.0, 320.0, 240.0)


def test_known_intrinsics_that_are_no_numbers_are_shown() -> None:
    assert ReconstructConfig().known_params() is None
    with pytest.raises(ConfigError, match=r"separated by commas, got 'f=500'"):
        ReconstructConfig(camera_params="f=500")


@pytest.mark.parametrize(
    ("rotation", "translation"),
    [
        (np.eye(3, dtype=np.float32), np.zeros(3)),
        (np.eye(3), np.zeros(2)),
        (np.eye(4), np.zeros(3)),
        (np.zeros((2, 3, 3)), np.zeros((3, 3))),
        (np.eye(3).tolist(), np.zeros(3)),
    ],
    ids=["type", "translation", "rotation", "batches", "list"],
)
def test_this_run_checks_the_arrays_of_data(rotation: object, translation: object) -> None:
    assert len(Rigid3(np.full((2, 3, 3), np.nan), np.zeros((2, 3)))) == 2
    with pytest.raises(Exception, match=r"(?i)type-check error"):
        Rigid3(rotation, translation)  # type: ignore[arg-type]


def test_this_run_checks_the_arguments_of_functions() -> None:
    with pytest.raises(Exception, match=r"(?i)type-check error.*\n?.*random_order"):
        random_order(np.ones(3, bool), StereoConfig())  # type: ignore[arg-type]


def test_random_numbers_are_the_same_in_every_test(rng: np.random.Generator) -> None:
    np.testing.assert_array_equal(
        rng.integers(1 << 30, size=4), np.random.default_rng(20260).integers(1 << 30, size=4)
    )


def test_options_of_another_kind_are_refused(tmp_path):
    assert options_of(StereoConfig, None) == StereoConfig()
    with pytest.raises(ConfigError, match=r"StereoConfig\(\*\*it\)"):
        options_of(StereoConfig, {"paths": 4})
    with pytest.raises(ConfigError, match="not a FeatureConfig"):
        options_of(StereoConfig, FeatureConfig())
    with pytest.raises(ConfigError, match="path is empty"):
        epipole.calibrate("", tmp_path / "out")


def test_an_error_about_a_file_comes_whole_out_of_another_process() -> None:
    error = pickle.loads(pickle.dumps(FileFormatError("folder/a.jpg", "is cut short")))
    assert str(error) == "folder/a.jpg: is cut short" and error.path == Path("folder/a.jpg")


def test_what_an_error_quotes_of_a_file_has_an_end_and_can_be_printed() -> None:
    error = FileFormatError("a.json", "the name \ud800 " + "x" * 100_000)
    assert len(str(error)) < 5000 and "\\ud800" in str(error)
    str(error).encode()
