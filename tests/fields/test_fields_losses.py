"""What a reconstruction has lost is repeated by the jobs that go on with it, on the screen and in their files."""

import json
from types import SimpleNamespace

import pytest
from fields_scenes import camera, frames_of, views

from epipole import convert, nerf, splat, undistort
from epipole.io.colmap.model import write_colmap_model
from epipole.io.models.losses import losses_in
from epipole.io.models.transforms import read_transforms
from epipole.pipelines.fields import training
from epipole.pipelines.fields.comparison import compare_fields
from whole import in_whole_run

SUMMARY = {
    "warnings": ["3 of 17 images are in no model"],
    "models": [{"num_registered": 14}, {"num_registered": 2}],
    "not_registered": {"cut.jpg": "is truncated", "x<b>.jpg": "no overlap", "z.jpg": "no overlap"},
}
LOST = ("3 of 17 images", "2 disconnected models", "cut.jpg is not registered: is truncated")


def reconstructed(folder):
    """An output folder as `reconstruct` leaves it, of two models."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = frames_of(views(with_alpha=False), folder)
    for frame in frames:
        frame["file_path"] = frame["file_path"].removeprefix("images/")
    (folder / "transforms_all.json").write_text(json.dumps(camera() | {"frames": frames}))
    model = read_transforms(folder / "transforms_all.json", image_folder="")
    for number in (0, 1):
        write_colmap_model(model, folder / "sparse" / str(number))
    (folder / "summary.json").write_text(json.dumps(SUMMARY))
    return folder


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    return reconstructed(tmp_path_factory.mktemp("losses") / "workspace")


def holds_all(text):
    return all(words in text for words in LOST)


def test_a_training_says_what_the_reconstruction_it_chained_has_lost(workspace, tmp_path, monkeypatch):
    def reconstruct(source, out, **_):
        reconstructed(out)
        return SimpleNamespace(summary=SUMMARY)

    monkeypatch.setattr(training, "reconstruct", reconstruct)
    found = splat(workspace / "images", tmp_path / "out", steps=2, max_gaussians=50)
    assert holds_all("\n".join(found.warnings))
    assert holds_all("\n".join(json.loads((found.out / "summary.json").read_text())["warnings"]))
    page = (found.out / "report.html").read_text()
    assert holds_all(page) and "x<b>" not in page


@in_whole_run
def test_so_does_one_of_a_finished_reconstruction(workspace, tmp_path):
    found = nerf(workspace, tmp_path / "out", steps=2, kind="grid")
    assert holds_all("\n".join(found.warnings)) and len(found.warnings) == len(set(found.warnings))
    both = compare_fields(workspace, tmp_path / "both", steps=1, kind="grid")
    assert holds_all("\n".join(json.loads((both.out / "compare.json").read_text())["warnings"]))
    assert len(both.warnings) == len(set(both.warnings))
    alone = splat(workspace / "sparse" / "1", tmp_path / "alone", steps=1, max_gaussians=50)
    assert not alone.warnings  # a model that was named


def test_so_do_conversion_and_undistortion(workspace, tmp_path):
    assert holds_all("\n".join(convert(workspace, tmp_path / "text", "txt").warnings))
    assert holds_all("\n".join(convert(workspace, tmp_path / "points.ply").warnings))
    notes = []
    out = undistort(workspace, lambda report: notes.append(report.note), target=tmp_path / "flat")
    assert holds_all("\n".join(notes))
    assert holds_all("\n".join(json.loads((out / "summary.json").read_text())["warnings"]))
    assert not convert(workspace / "sparse" / "1", tmp_path / "one", "txt").warnings


def test_a_workspace_without_a_summary_of_ours_still_tells_its_models(workspace, tmp_path):
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    assert losses_in(tmp_path) == [] == losses_in(tmp_path / "nowhere")
    (tmp_path / "sparse" / "1").mkdir()
    assert "2 disconnected models" in losses_in(tmp_path)[0]
    for damaged in ("[]", '{"not_registered": 3}', "{"):
        (tmp_path / "summary.json").write_text(damaged)
        assert len(losses_in(tmp_path)) == 1
    many = SUMMARY | {"not_registered": {f"{n}.jpg": "blurred" for n in range(30)}, "warnings": [3]}
    (tmp_path / "summary.json").write_text(json.dumps(many))
    assert losses_in(tmp_path)[-1].startswith("25 more images are in no model")


def test_reading_images_is_reported(workspace, tmp_path):
    reports = []
    nerf(workspace, tmp_path / "out", steps=1, kind="grid", progress=reports.append)
    done = [(report.done, report.total) for report in reports if report.stage == "load"]
    assert done == [(n, 14) for n in range(15)]
