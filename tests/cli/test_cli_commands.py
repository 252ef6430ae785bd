"""Every command, end to end, on rendered photographs."""

import json
import os
import re
import subprocess
import sys
from contextlib import redirect_stdout
from dataclasses import fields
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import type_checks

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "sfm"))
from photographs import neighboring_views, render_to

from epipole.cli.main import main
from epipole.errors import FileFormatError
from epipole.geometry import Rigid3
from epipole.io import read_colmap_model, write_colmap_model
from epipole.io.calibration.files import CalibrationFile, write_calibration
from epipole.io.images.depth_maps import read_pfm
from epipole.io.images.writing import write_photograph
from epipole.metrics import camera_errors
from epipole.pipelines.stereo import command
from epipole.pipelines.stereo.config import RigOptions, StereoConfig
from epipole.synthetic.stereo_rooms import stereo_room


def run(*arguments, expect=0):
    done = subprocess.run(
        [sys.executable, "-m", "epipole.cli.main", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == expect, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture
def here(capsys, unchecked):
    """The same in this process, which has loaded what the command needs."""

    def run_here(*arguments, expect=0):
        code = 0
        try:
            main([*map(str, arguments)])
        except SystemExit as stopped:
            code = int(stopped.code or 0)
        said = capsys.readouterr()
        assert code == expect, said.out + said.err
        return said.out + said.err

    return run_here


COUNT = 5
"""Of photographs."""


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cli")
    views = neighboring_views(COUNT)
    names = render_to(folder / "photographs", views)
    with redirect_stdout(StringIO()) as printed, type_checks.switched_off():
        main(["reconstruct", str(folder / "photographs"), str(folder / "out")])
    return folder, names, views, printed.getvalue()


def test_demo_leaves_other_peoples_folders_alone(tmp_path, here):
    mine = tmp_path / "photographs" / "IMG_1.jpg"
    mine.parent.mkdir()
    mine.write_text("precious")
    assert "was not written by epipole" in here("demo", tmp_path, expect=1)
    assert mine.read_text() == "precious"


def test_reconstruct_places_every_photograph_near_the_truth(workspace):
    folder, names, views, printed = workspace
    assert f"{COUNT} of {COUNT}" in printed and "report.html" in printed
    model = read_colmap_model(folder / "out" / "sparse" / "0")
    assert model.images.name == tuple(names)
    errors = camera_errors(model.cams_from_world(), views)
    size = np.linalg.norm(np.ptp(views.centers(), axis=0))
    assert errors.mean_position < 2e-3 * size
    assert errors.max_rotation_deg < 0.2
    assert model.mean_reprojection_error_px() < 0.8
    for name in (
        "config.json",
        "summary.json",
        "report.html",
        "database.db",
        "points.ply",
        "images/view_00.jpg",
    ):
        assert (folder / "out" / name).is_file(), name
    assert json.loads((folder / "out" / "summary.json").read_text())["num_registered"] == COUNT


def test_again_it_redoes_nothing_and_gives_the_same_bytes(workspace, here):
    folder, _, _, _ = workspace
    before = (folder / "out" / "sparse" / "0" / "points3D.bin").read_bytes()
    stamps = {p: p.stat().st_mtime_ns for p in (folder / "out" / "work").rglob("*.npz")}
    here("reconstruct", folder / "photographs", folder / "out")
    assert (folder / "out" / "sparse" / "0" / "points3D.bin").read_bytes() == before
    assert stamps == {p: p.stat().st_mtime_ns for p in (folder / "out" / "work").rglob("*.npz")}


def test_one_thread_gives_the_same_bytes(workspace, here):
    folder, _, _, _ = workspace
    here("reconstruct", folder / "photographs", folder / "one", "--threads", "1")
    for name in ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"):
        a, b = (folder / out / "sparse" / "0" / name for out in ("out", "one"))
        assert a.read_bytes() == b.read_bytes(), name


def test_a_changed_option_redoes_only_what_depends_on_it(workspace, here):
    folder, _, _, _ = workspace
    stamps = {p.name: p.stat().st_mtime_ns for p in (folder / "one" / "work" / "features").iterdir()}
    here("reconstruct", folder / "photographs", folder / "one", "--matching.max-ratio", "0.7")
    assert stamps == {p.name: p.stat().st_mtime_ns for p in (folder / "one" / "work" / "features").iterdir()}


def test_evaluate_undistort_and_convert(workspace, here):
    folder, names, views, _ = workspace
    model = read_colmap_model(folder / "out" / "sparse" / "0")
    from dataclasses import replace

    truth = replace(
        model, frames=replace(model.frames, rig_from_world=Rigid3(views.rotation, views.translation))
    )
    write_colmap_model(truth, folder / "truth")
    result = json.loads(here("evaluate", folder / "out", "--truth", folder / "truth", "--json"))
    assert result["num_registered"] == COUNT and result["position_mean"] < 0.02 and result["auc"]["5"] > 0.95
    assert f"{COUNT} of {COUNT}" in here("evaluate", folder / "out", "--truth", folder / "truth")
    here("undistort", folder / "out")
    flat = read_colmap_model(folder / "out" / "undistorted" / "sparse" / "0")
    assert flat.cameras[0].model.name == "PINHOLE"
    assert len(list((folder / "out" / "undistorted" / "images").iterdir())) == len(names)
    assert flat.mean_reprojection_error_px() < 0.8
    for form in ("txt", "bin", "ply", "transforms", "bundler", "opensfm", "metashape", "kapture"):
        here("convert", folder / "out", folder / f"as_{form}", "--format", form)


def test_errors_are_one_line_and_a_code(tmp_path, here):
    printed = run("reconstruct", tmp_path / "nothing", tmp_path / "out", expect=1)
    assert printed.count("Traceback") == 0 and "does not exist" in printed
    assert "contains no model" in here("view", tmp_path, expect=1)
    assert "epipole" in here("version")


def test_stereo_of_two_files(tmp_path, here):
    pair = stereo_room(9, (240, 180))
    left, right = tmp_path / "left.png", tmp_path / "right.png"
    Image.fromarray(pair.left).save(left)
    Image.fromarray(pair.right).save(right)
    known = ("--focal-px", pair.camera.K[0, 0], "--baseline", pair.baseline)
    printed = here("stereo", left, right, tmp_path / "out", *known)
    assert "of the pixels known" in printed and "points" in printed
    found, truth = (
        read_pfm(tmp_path / "out" / "depth.pfm"),
        pair.camera.K[0, 0] * pair.baseline / pair.disparity_px,
    )
    both = np.isfinite(found) & np.isfinite(truth)
    assert both.mean() > 0.6 and np.median(np.abs(found / truth - 1)[both]) < 0.05
    said = here("stereo", left, right, tmp_path / "two", "--focal-px", 500, expect=2)
    assert "depth needs both --focal-px and --baseline, but only --focal-px was given" in said
    assert (
        "it does not exist" in here("stereo", left, tmp_path / "none.png", tmp_path / "two", expect=1).lower()
    )
    assert not (tmp_path / "two").exists()


def _cpu_of_children() -> float:
    """CPU seconds of the processes that have ended; unlike the wall clock, they hardly depend on what else runs."""
    used = os.times()
    return used.children_user + used.children_system


def test_help_is_quick_and_loads_nothing_heavy():
    times = []
    for _ in range(6):
        start = _cpu_of_children()
        printed = run("--help")
        times.append(_cpu_of_children() - start)
        if times[-1] < 0.6:  # a busy machine may be slow now and then
            break
    assert "reconstruct" in printed
    assert min(times) < 0.6
    loaded = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "epipole.cli.main", "--help"],
        capture_output=True,
        text=True,
        check=True,
    ).stderr
    assert re.search(r"\| +tyro$", loaded, re.MULTILINE)
    for heavy in ("numpy", "numba", "scipy", "cv2", "jinja2", "http.server", "PIL"):
        assert not re.search(rf"\| +{heavy}$", loaded, re.MULTILINE), heavy


def test_undistort_says_what_it_cannot_write(tmp_path):
    rgb = np.zeros((8, 8, 3), np.uint8)
    with pytest.raises(FileFormatError, match="convert the image"):
        write_photograph(tmp_path / "a.heic", rgb)
    write_photograph(tmp_path / "a.png", rgb)
    assert (tmp_path / "a.png").is_file()


def saved_pair(folder, size=(200, 150)):
    pair = stereo_room(8, size)
    for side in ("left", "right"):
        Image.fromarray(getattr(pair, side)).save(folder / f"{side}.png")
    return pair, str(folder / "left.png"), str(folder / "right.png")


def test_stereo_by_a_calibration_and_the_doctor(tmp_path, here):
    pair, left, right = saved_pair(tmp_path)
    motion = Rigid3(np.stack([np.eye(3)] * 2), np.array([[0.0, 0, 0], [-pair.baseline, 0, 0]]))
    known = tmp_path / "rig.json"
    write_calibration(known, CalibrationFile((pair.camera, pair.camera), motion, np.diag(np.full(30, 1e-8))))
    printed = here("stereo", left, right, tmp_path / "out", "--calibration", known)
    assert "points" in printed
    assert {"depth.pfm", "rig.json", "left.png", "cloud.ply"} <= {
        p.name for p in (tmp_path / "out").iterdir()
    }
    printed = here("stereo", "doctor", left, right, "--calibration", known, "--json")
    given = json.loads(printed[printed.index("{") : printed.rindex("}") + 1])
    assert given["problems"] == [] and given["expectations"][0]["from_calibration"] > 0
    assert "swapped" in here("stereo-doctor", right, left)
    both = ("--calibration", known, "--focal-px", "3")
    assert "not both" in here("stereo", left, right, tmp_path / "x", *both, expect=2)


def test_stereo_says_what_it_needs(tmp_path, here):
    _, left, right = saved_pair(tmp_path, (120, 90))
    for arguments, words, code in (
        ((left, right), "needs LEFT RIGHT OUT, got ", 2),
        (("--workspace", tmp_path, tmp_path / "out"), "--pair A B", 2),
        ((left, tmp_path, tmp_path / "out"), "not a folder", 1),
        ((left, right, tmp_path / "out", "--calibration", left), "neither JSON nor YAML", 1),
    ):
        printed = here("stereo", *arguments, expect=code)
        assert words in printed and "Traceback" not in printed


def test_calibrate_names_what_is_wrong(tmp_path, here):
    saved_pair(tmp_path, (120, 90))
    printed = here("calibrate", tmp_path, tmp_path / "out", "--columns", "9", "--rows", "6", expect=1)
    assert "no board found in the" in printed and "Traceback" not in printed


@pytest.mark.parametrize(
    ("given", "changed"),
    [
        ("L R O", {}),
        ("L R --calibration a --calibration b O", {"calibration": ("a", "b")}),
        ("--fill L R O --calibration a", {"fill": True, "calibration": ("a",)}),
        ("--calibration a --cameras 2 3 L R O", {"calibration": ("a",), "cameras": (2, 3)}),
        ("L R O --calibration=m --cameras 2 3", {"calibration": ("m",), "cameras": (2, 3)}),
        ("--principal-point 3 4.5 L R O", {"principal_point": (3.0, 4.5)}),
        ("L --window 7 7 R O --no-fill", {"window": (7, 7)}),
        ("L R O --min-disparity-px -5", {"min_disparity_px": -5}),
        ("L R --max-disparity-px 90 O", {"max_disparity_px": 90}),
    ],
)
def test_paths_and_options_of_stereo_in_any_order(given, changed, monkeypatch):
    seen = []
    monkeypatch.setattr(command, "_measure", lambda *arguments: seen.append(arguments) or True)
    main(["stereo", *given.split()])
    (left, right, out, *options), *_ = seen
    assert (str(left), str(right), str(out)) == ("L", "R", "O")
    values = {f.name: getattr(each, f.name) for each in options for f in fields(each)}
    requested = {
        f.name: getattr(each, f.name) for each in (StereoConfig(), RigOptions()) for f in fields(each)
    }
    requested |= changed
    values["calibration"] = tuple(map(str, values["calibration"]))
    assert values == requested


@pytest.mark.parametrize("given", ["--workspace W --pair A B O", "O --pair A B --workspace W"])
def test_a_pair_of_a_model_has_one_path(given, monkeypatch):
    seen = []
    monkeypatch.setattr(command, "_measure_of_model", lambda *arguments: seen.append(arguments))
    main(["stereo", *given.split()])
    workspace, pair, out, _ = seen[0]
    assert (str(workspace), pair, str(out)) == ("W", ("A", "B"), "O")


@pytest.mark.parametrize(
    "given", ["stereo-doctor --strict L R --calibration a", "stereo doctor --calibration a L R --strict"]
)
def test_the_doctor_by_both_names(given, monkeypatch):
    seen = []
    monkeypatch.setattr(command, "_examine", lambda *arguments: seen.append(arguments) or True)
    main(given.split())
    left, right, rig, _ = seen[0]
    assert (str(left), str(right), rig) == ("L", "R", RigOptions(calibration=(Path("a"),)))


@pytest.mark.parametrize(
    "given", ["L R O --calibration", "L R O --cameras 1", "L R O --cameras 1 two", "L R", "L R O P"]
)
def test_words_too_few_or_too_many_are_refused(given):
    with pytest.raises(SystemExit) as stopped:
        main(["stereo", *given.split()])
    assert stopped.value.code in (1, 2)
