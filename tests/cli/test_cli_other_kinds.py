"""What is given is of another kind than what a command reads: the message says what it is, and what to do."""

import json
import re
import zipfile
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import epipole
from epipole.cameras import Camera
from epipole.cli.main import main
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3
from epipole.io import write_points_ply
from epipole.io.calibration.files import CalibrationFile, write_calibration
from epipole.io.contents_in_words import results_of, what_it_is
from epipole.io.gaussians.ply import write_gaussian_ply
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.sfm.gps.evidence import GpsEvidence
from epipole.pipelines.sfm.gps.gps_notes import gps_notes
from epipole.pipelines.slam.config import CameraOptions
from epipole.scene.gaussian_cloud import GaussianCloud


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Files and folders of many kinds, in the current folder."""
    monkeypatch.chdir(tmp_path)
    Path("x.glb").write_bytes(b"glTF" + bytes(16))
    Path("x.obj").write_text("v 0 0 0\n")
    Path("x.insv").write_bytes(b"\0\0\0\x20ftypmp42" + bytes(300))
    Path("clip.mp4").write_bytes(b"\0\0\0\x20ftypmp42" + bytes(300))
    zipfile.ZipFile("x.zip", "w").writestr("a.txt", "a")
    for folder in ("images", "slammed", "empty", "splatted"):
        Path(folder).mkdir()
    for n in range(3):
        cv2.imwrite(f"images/{n}.png", np.zeros((40, 60, 3), np.uint8))
    Path("slammed/epipole.json").write_text(json.dumps({"format": 3, "kind": "slam"}))
    write_points_ply("points.ply", np.eye(3), np.zeros((3, 3), np.uint8))
    return tmp_path


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("mesh slammed m.ply", "contains no trained Gaussians .*; it holds the results of `epipole slam`"),
        ("mesh images m.ply", "it holds images"),
        ("render slammed out", "it holds the results of `epipole slam`"),
        ("render x.glb out", r"it is a glTF scene \(\.glb\), which is not supported: export .* PLY"),
        ("convert x.glb y.ply", "glTF scene"),
        ("convert x.obj y.ply", "Wavefront OBJ mesh, which is not supported"),
        ("convert x.glb y --format txt", "not a model: it is a glTF scene"),
        ("convert images/0.png y --format txt", "not a model: it is a PNG image"),
        ("convert nowhere y --format txt", "it does not exist"),
        ("convert slammed x.glb", r"unknown output format of .*x\.glb: use the suffix \.ply or .*\.spz"),
        ("convert slammed y --format txt", "contains no model .*it holds the results of `epipole slam`"),
        ("reconstruct x.zip out", "it is a ZIP archive: unpack it and pass the folder"),
        ("reconstruct images/0.png out", "it is a PNG image"),
        ("reconstruct x.insv out", "360-degree camera .*export a flat perspective video"),
        ("slam x.insv out", "360-degree camera .*export a flat perspective video"),
        ("stereo x.insv x.insv out", "360-degree camera .*export a flat perspective video"),
        ("splat x.insv out", "360-degree camera .*export a flat perspective video"),
        ("slam x.zip out", "it is a ZIP archive"),
        ("slam images out --map slammed", r"contains no SLAM map \(map/map\.npz\); it holds the results of"),
        (
            "slam images out --map images",
            "contains no SLAM map .*; it holds images .*; pass the output folder",
        ),
        ("slam images out --map nowhere", "contains no SLAM map .*; it does not exist"),
        ("slam images out --map images/0.png", "not a map, or damaged; it is a PNG image"),
        ("undistort x.glb", "glTF scene"),
        ("view x.zip", "not a file that can be shown; it is a ZIP archive"),
        ("view clip.mp4", "it is a video"),
        (
            "evaluate slammed --truth images",
            "not cameras in a supported format; it holds images|contains no model",
        ),
        ("splat images out --time 5", "--time needs a unit: 5s for seconds, 5m for minutes or 5h for hours"),
        ("nerf images out --time 2.5", r"--time needs a unit: 2\.5s"),
        ("compare-fields images out --time 5min", "--time must be a number with a unit, such as 30s"),
    ],
)
def test_the_message_says_what_it_is(here, words, said, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(words.split())
    assert stopped.value.code in (1, 2)
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines[-1].startswith("epipole: ")
    assert re.search(said, lines[-1]), lines[-1]


@pytest.mark.parametrize("job, target", [(epipole.mesh, "out.ply"), (epipole.render, "out")])
def test_cameras_that_are_not_there(here, job, target):
    splats = here / "splatted" / "splat.ply"
    arrays = (np.zeros((1, 3)), np.zeros((1, 3)), np.ones((1, 4)), np.zeros(1), np.zeros((1, 1, 3)))
    write_gaussian_ply(splats, GaussianCloud(*(array.astype(np.float32) for array in arrays)))
    for cameras, said in (
        ("nofile.json", "it does not exist; models are read"),
        ("x.glb", "glTF scene"),
    ):
        with pytest.raises(FileFormatError, match=said):
            job(splats.parent, here / target, cameras=here / cameras)
    if job is epipole.mesh:
        with pytest.raises(
            epipole.errors.NoModelError, match=r"cameras\.json does not exist: pass a transforms\.json"
        ):
            job(splats, here / target)


def test_a_calibration_of_two_cameras_is_not_one_camera(here):
    one = Camera("PINHOLE", 60, 40, [50.0, 51.0, 30.0, 20.0])
    other = Camera("PINHOLE", 60, 40, [70.0, 71.0, 30.0, 20.0])
    write_calibration(here / "pair.json", CalibrationFile((one, other), Rigid3.identity(2)))
    said = (
        r"has 2 cameras, .*camera_params 50,51,30\.5,20\.5 or camera_model PINHOLE and camera_params 70,71,"
    )
    with pytest.raises(ConfigError, match=said):
        CameraOptions(calibration=here / "pair.json").camera((60, 40))
    with pytest.raises(ConfigError, match=said):
        epipole.reconstruct(here / "images", here / "out", calibration=here / "pair.json")


def test_a_time_with_its_unit_is_understood():
    times = {"30s": 30.0, "5m": 300.0, "1h": 3600.0, "0.5m": 30.0, " 2m ": 120.0}
    assert {text: FieldOptions(time=text).seconds for text in times} == times


@pytest.mark.usefixtures("unchecked")
def test_gps_that_is_not_used_does_not_make_a_known_scale_unknown():
    """Where tags, lengths or measured places have told the scale."""
    model = SimpleNamespace(is_registered=lambda: np.ones(4, bool))
    images = SimpleNamespace(lat_lon_alt=np.array([[50.0, 10.0, 0.0]] * 2 + [[np.nan] * 3] * 2))
    config = epipole.MapperConfig()
    for scale, said in ((None, "the scale is unknown: "), ("by tags", "GPS is not used: ")):
        mapped = SimpleNamespace(models=(model,), gps=(None,), pose_fits=(None,), scale=scale)
        (note,) = gps_notes(images, mapped, config)
        assert note.startswith(said)


def test_distances_below_a_meter_are_not_none():
    said = GpsEvidence(12, 0.042, 3.25, 0.5).in_words()
    assert "0.042 m or more" in said and "spread over 3.2 m" in said
    assert "are 41 m or more" in GpsEvidence(12, 41.2, 300.0, 0.5).in_words()


def test_what_paths_hold(here):
    assert what_it_is(here / "empty") == "it is empty" and what_it_is(here / "splatted") == "it is empty"
    assert what_it_is(here / "nowhere") == "it does not exist"
    assert what_it_is(here / "points.ply") == "it is a PLY file of points or triangles"
    for damaged in ("{", "[]", '{"kind": 3}', '{"kind": "rm -rf"}'):
        (here / "empty" / "epipole.json").write_text(damaged)
        assert results_of(here / "empty") == ""
