"""`epipole.splat`: from cameras and images to Gaussians, held-out images and figures; and what is wrong with them."""

import json
import os
import signal
from dataclasses import replace

import cv2
import numpy as np
import pytest
from fields_scenes import CAMERA, camera, frames_of, scene, views

from epipole import splat, view
from epipole.errors import ConfigError, FileFormatError, NoModelError, WorkspaceError
from epipole.fields.splat.trainer import SplatTrainer
from epipole.fields.training_view import TrainingView
from epipole.geometry import Rigid3
from epipole.io import write_points_ply
from epipole.io.gaussians.ply import read_gaussian_ply
from epipole.io.models.transforms import read_transforms
from epipole.pipelines.fields import checkpoints, training
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.images import gather_field_images
from epipole.pipelines.fields.scene import is_mine, seen_gaussians

pytestmark = pytest.mark.usefixtures("unchecked_module")
OPTIONS = {"steps": 80, "max_gaussians": 400, "sh_degree": 1}


@pytest.fixture(scope="module")
def result(source, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(training, "PROBE_FRACTION", np.inf)
        return splat(source, tmp_path_factory.mktemp("splat") / "out", test_every=7, **OPTIONS)


def test_results_are_written(result):
    out = result.out
    cloud = read_gaussian_ply(out / "splat.ply")
    assert len(cloud) == len(result.cloud) == result.summary["num_gaussians"]
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["num_train"] == 12 and metrics["num_test"] == 2 and metrics["steps"] == 80
    assert [view["name"] for view in metrics["views"]] == ["images/00.png", "images/07.png"]
    assert metrics["psnr"] == pytest.approx(np.mean([view["psnr"] for view in metrics["views"]]))
    assert metrics["psnr"] > 20 and metrics["background"] == "white" and len(metrics["curve"]["rows"]) > 5
    names = sorted(path.name for path in (out / "test").iterdir())
    assert names == ["images_00.png", "images_07.png"]
    rendered = cv2.imread(str(out / "test" / "images_00.png"))[..., ::-1].astype(float) / 255
    error = np.mean((rendered - views()[0].over(np.ones(3, np.float32))) ** 2)
    assert -10 * np.log10(error) == pytest.approx(metrics["views"][0]["psnr"], abs=0.1)


def test_the_report_shows_what_was_held_out(result):
    metrics = json.loads((result.out / "metrics.json").read_text())
    seconds, steps, photometric_loss = np.array(metrics["held_out"]["rows"]).T
    assert len(steps) == 8 and (np.diff(steps) > 0).all() and (np.diff(seconds) > 0).all()
    assert photometric_loss[-1] > photometric_loss[0] and photometric_loss[-1] == pytest.approx(
        metrics["psnr"], abs=3.0
    )
    page = (result.out / "report.html").read_text()
    assert f"{metrics['psnr']:.1f} dB on held-out views" in page
    assert page.count("data:image/png") == 3 * 2 and "images/07.png" in page and "PSNR, dB" in page


def test_held_out_views_that_take_too_long_are_left_out(source, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "PROBE_FRACTION", 0.0)
    found = splat(source, tmp_path / "out", test_every=7, **OPTIONS | {"steps": 5})
    assert json.loads((found.out / "metrics.json").read_text())["held_out"]["rows"] == []
    assert "data:image/png" in (found.out / "report.html").read_text()


def test_names_are_text_in_the_report(tmp_path):
    name = "<img src=x onerror=alert(1)>.png"
    named = [replace(view, name=name if n == 0 else view.name) for n, view in enumerate(views()[:4])]
    (tmp_path / "transforms.json").write_text(json.dumps(camera() | {"frames": frames_of(named, tmp_path)}))
    found = splat(tmp_path, tmp_path / "out", steps=2, test=f"images/{name}")
    page = (found.out / "report.html").read_text()
    assert "<img src=x" not in page and "&lt;img src=x" in page


def test_results_are_shown_from_where_a_picture_was_taken(result, tmp_path):
    assert is_mine(result.out) and is_mine(result.out / "splat.ply") and not is_mine(tmp_path)
    cloud, shown = seen_gaussians(result.out)
    np.testing.assert_allclose(shown.position, views()[1].cam_from_world.inverse().translation, atol=1e-9)
    assert np.linalg.norm(shown.look_at) < 0.5 and shown.up[2] > 0.9
    (tmp_path / "alone.ply").write_bytes((result.out / "splat.ply").read_bytes())
    (tmp_path / "summary.json").write_text('{"first_view": {"position": [1, 2]}}')
    same, alone = seen_gaussians(tmp_path / "alone.ply")
    assert len(same) == len(cloud) and np.isfinite(alone.position).all()
    handle = view(result.out, block=False)
    handle.stop()


def test_pictures_can_be_held_out_by_name(source, tmp_path):
    found = splat(source, tmp_path / "out", test="images/03.png, images/05.png", **OPTIONS | {"steps": 3})
    assert (found.summary["num_train"], found.summary["num_test"]) == (12, 2)
    with pytest.raises(ConfigError, match="nowhere"):
        splat(source, tmp_path / "other", test="nowhere.png", **OPTIONS)


def test_the_same_steps_give_the_same(source, result, tmp_path):
    again = splat(source / "transforms.json", tmp_path / "out", test_every=7, **OPTIONS)
    assert (again.out / "splat.ply").read_bytes() == (result.out / "splat.ply").read_bytes()


def test_pictures_that_are_missing_are_left_out_and_named(source, tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    frames = frames_of(views(), folder)
    (folder / "images" / "03.png").unlink()
    (folder / "images" / "04.png").write_bytes(b"no image")
    (folder / "transforms.json").write_text(json.dumps(camera() | {"frames": frames}))
    found = splat(folder, tmp_path / "out", **OPTIONS | {"steps": 3})
    assert found.summary["num_train"] + found.summary["num_test"] == 12
    assert [warning.split()[0] for warning in found.warnings] == ["images/03.png", "images/04.png"]


def test_sets_with_a_split_of_their_own_keep_it(tmp_path):
    frames = frames_of(views(), tmp_path)
    for name, own in (("train", frames[:10]), ("test", frames[10:])):
        angle = 2 * np.arctan(0.5 * CAMERA.width / CAMERA.params[0])
        (tmp_path / f"transforms_{name}.json").write_text(
            json.dumps({"camera_angle_x": angle, "frames": own})
        )
    found = splat(tmp_path, tmp_path / "out", **OPTIONS | {"steps": 3})
    assert (found.summary["num_train"], found.summary["num_test"]) == (10, 4)


def test_masks_lie_beside_by_name(source, tmp_path):
    mask = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    mask[:, :20] = 0
    (tmp_path / "masks" / "images").mkdir(parents=True)
    for name in ("00.png", "03.png"):
        cv2.imwrite(str(tmp_path / "masks" / "images" / f"{name}.png"), mask)
    options = FieldOptions(masks=tmp_path / "masks", test_every=7)
    gathered = gather_field_images(source, options)
    by_name = {view.name: view.used_mask for view in [*gathered.train, *gathered.test]}
    assert sorted(name for name, used in by_name.items() if used is not None) == [
        "images/00.png",
        "images/03.png",
    ]
    np.testing.assert_array_equal(by_name["images/03.png"], mask > 0)
    small = gather_field_images(source, replace(options, max_side_px=32))
    half = next(view for view in small.train if view.name == "images/03.png").used_mask
    assert half.shape == (24, 32) and not half[:, :10].any() and half[:, 10:].all()
    found = splat(source, tmp_path / "out", masks=options.masks, **OPTIONS | {"steps": 3, "test_every": 7})
    fixed = json.loads((found.out / "metrics.json").read_text())["views"][0]
    assert fixed["name"] == "images/00.png" and np.isfinite([fixed["psnr"], fixed["psnr_matched"]]).all()
    (tmp_path / "other").mkdir()
    with pytest.raises(ConfigError, match="has no mask for any image"):
        gather_field_images(source, replace(options, masks=tmp_path / "other"))
    cv2.imwrite(str(tmp_path / "masks" / "images" / "05.png.png"), mask[:5])
    assert any("mask is" in problem for problem in gather_field_images(source, options).problems)
    cv2.imwrite(str(tmp_path / "masks" / "images" / "06.png.png"), np.zeros_like(mask))
    problems = gather_field_images(source, options).problems
    assert any(problem.startswith("images/06.png") and "covers all of it" in problem for problem in problems)


def test_cameras_that_moved_are_written(source, tmp_path):
    options = OPTIONS | {"test_every": 0, "refine_poses": True, "exposure": True}
    found = splat(source, tmp_path / "out", **options)
    moved = read_transforms(found.out / "cameras.json", image_folder="").cams_from_world()
    off = [np.linalg.norm((moved[n] @ view.cam_from_world.inverse()).log()) for n, view in enumerate(views())]
    assert 1e-5 < np.median(off) < 0.2


def test_an_interrupt_keeps_what_was_learned(source, tmp_path):
    def stop(progress):
        if progress.stage == "train" and progress.done > 30:
            raise KeyboardInterrupt

    found = splat(source, tmp_path / "out", progress=stop, **OPTIONS)
    assert found.summary["interrupted"] and 10 < found.summary["steps"] < 80
    assert len(read_gaussian_ply(tmp_path / "out" / "splat.ply")) == found.summary["num_gaussians"]


def test_what_was_interrupted_goes_on_with_the_same_bits(source, tmp_path):
    def stop(progress):
        if progress.stage == "train" and progress.done > 50:
            raise KeyboardInterrupt

    whole = splat(source, tmp_path / "whole", **OPTIONS)
    first = splat(source, tmp_path / "out", progress=stop, **OPTIONS)
    steps = first.summary["steps"]
    assert first.summary["interrupted"] and (tmp_path / "out" / "checkpoint.npz").is_file()
    found = splat(source, tmp_path / "out", **OPTIONS)
    assert f"continued an earlier run at step {steps}" in found.warnings[0] and found.summary["steps"] == 80
    for name in ("means_in_world", "log_scales", "quats_wxyz", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(found.cloud, name), getattr(whole.cloud, name))
    curve = json.loads((tmp_path / "out" / "metrics.json").read_text())["curve"]["rows"]
    assert [row[1] for row in curve] == sorted({row[1] for row in curve}) and curve[0][1] == 1
    assert not (tmp_path / "out" / "checkpoint.npz").exists()


def test_other_options_or_a_damaged_checkpoint_begin_anew(source, tmp_path):
    def stop(progress):
        if progress.stage == "train" and progress.done > 50:
            raise KeyboardInterrupt

    splat(source, tmp_path / "out", progress=stop, **OPTIONS)
    file = tmp_path / "out" / "checkpoint.npz"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    assert not splat(source, tmp_path / "out", **OPTIONS).warnings
    splat(source, tmp_path / "out", progress=stop, **OPTIONS)
    assert not splat(source, tmp_path / "out", **OPTIONS | {"seed": 3}).warnings


def test_a_full_disk_ends_no_training(source, tmp_path, monkeypatch):
    def full(*_):
        raise WorkspaceError("the disk is full")

    monkeypatch.setattr(checkpoints, "store", full)
    monkeypatch.setattr(checkpoints, "EVERY_S", -1.0)
    found = splat(source, tmp_path / "out", **OPTIONS | {"steps": 3})
    assert found.summary["steps"] == 3 and len(found.warnings) == 1
    assert "cannot be continued later: the disk is full" in found.warnings[0]


def test_memory_is_told_first_and_kept(source, tmp_path):
    notes = []
    found = splat(source, tmp_path / "out", steps=2, memory_gb=0.24, progress=lambda p: notes.append(p.note))
    given = next(note for note in notes if note)
    assert "12 images, about 0.2 GB" in given
    assert found.summary["num_gaussians"] <= int(given.split()[2].replace(",", "")) <= 10_000
    with pytest.raises(ConfigError, match=r"memory_gb is 0\.01, but 0\.23 GB are needed"):
        splat(source, tmp_path / "small", steps=2, memory_gb=0.01)
    with pytest.raises(ConfigError, match="1,000,000 Gaussians"):
        splat(source, tmp_path / "small", steps=2, memory_gb=0.3, max_gaussians=1_000_000)


def test_cameras_that_look_away_are_told(tmp_path):
    points = scene().means_in_world.astype(float).repeat(2, 0)
    rgb = np.full((len(points), 3), 120, np.uint8)
    for name, rotation in (("good", 1.0), ("away", -1.0)):
        frames = [
            replace(
                view,
                cam_from_world=Rigid3.from_matrix(
                    np.diag([1, rotation, rotation, 1]) @ view.cam_from_world.as_matrix()
                ),
            )
            for view in views()
        ]
        (tmp_path / name).mkdir()
        points_file = {"ply_file_path": "points.ply"}
        write_points_ply(tmp_path / name / "points.ply", points, rgb)
        content = camera() | {"frames": frames_of(frames, tmp_path / name)} | points_file
        (tmp_path / name / "transforms.json").write_text(json.dumps(content))
        found = splat(tmp_path / name, tmp_path / f"{name}-out", steps=2)
        assert any("look away from the points" in words for words in found.warnings) == (name == "away")


def test_black_pictures_give_a_black_scene(tmp_path):
    dark = [
        TrainingView(v.name, v.image * np.array([0, 0, 0, 1], np.uint8), v.camera, v.cam_from_world)
        for v in views()
    ]
    (tmp_path / "transforms.json").write_text(json.dumps(camera() | {"frames": frames_of(dark, tmp_path)}))
    found = splat(tmp_path, tmp_path / "out", steps=60, background="black", max_gaussians=200)
    assert found.summary["psnr"] > 30


def test_what_cannot_be_trained_on_is_refused(source, tmp_path):
    one = tmp_path / "one"
    one.mkdir()
    (one / "transforms.json").write_text(json.dumps(camera() | {"frames": frames_of(views()[:1], one)}))
    with pytest.raises(NoModelError, match="two are needed"):
        splat(one, tmp_path / "out", test_every=0)
    with pytest.raises(FileFormatError, match="does not exist"):
        splat(tmp_path / "nowhere", tmp_path / "out")
    wrong = tmp_path / "wrong"
    wrong.mkdir()
    (wrong / "transforms.json").write_text(
        json.dumps(
            camera() | {"frames": [{"file_path": "a.png", "transform_matrix": [[float("nan")] * 4] * 4}]}
        )
    )
    with pytest.raises(FileFormatError, match="finite"):
        splat(wrong, tmp_path / "out")


def test_time_is_told_in_words():
    assert FieldOptions(time="90s").seconds == 90 and FieldOptions(time="1.5m").seconds == 90
    assert FieldOptions().seconds == 300 and FieldOptions(steps=5).seconds is None
    for wrong in (
        {"time": "soon"},
        {"time": "0s"},
        {"time": "5m", "steps": 3},
        {"steps": 0},
        {"test_every": 1},
    ):
        with pytest.raises(ConfigError):
            FieldOptions(**wrong)


@pytest.fixture
def python_hears_interrupts():
    """What is begun in the background of a shell is deaf to Ctrl-C."""
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, usual)


@pytest.mark.usefixtures("python_hears_interrupts")
def test_an_interrupt_in_the_middle_of_a_step_waits_for_its_end(source, tmp_path, monkeypatch):
    change = SplatTrainer._change

    def torn(self, progress):
        os.kill(os.getpid(), signal.SIGINT)
        change(self, progress)

    whole = splat(source, tmp_path / "whole", **OPTIONS)
    with monkeypatch.context() as patched:
        patched.setattr(SplatTrainer, "_change", torn)
        assert splat(source, tmp_path / "out", **OPTIONS).summary["interrupted"]
    found = splat(source, tmp_path / "out", **OPTIONS)
    np.testing.assert_array_equal(found.cloud.means_in_world, whole.cloud.means_in_world)
