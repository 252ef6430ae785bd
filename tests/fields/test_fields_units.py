"""Images of a field drawn by other threads, or by a cluster: the same as one after the other."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fields_scenes import scene

from epipole import nerf, render
from epipole.cli.main import main
from epipole.io.gaussians.files import write_gaussians
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.rendering import image_units
from whole import in_whole_run

pytestmark = pytest.mark.usefixtures("small_hash", "two_threads")
FOUR = {"frames": 4, "width": 40}


@pytest.fixture(scope="module")
def splats(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("splats") / "splat.ply"
    write_gaussians(path, scene())
    return path


@pytest.fixture(scope="module")
def trained(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A neural field."""
    out = tmp_path_factory.mktemp("trained") / "out"
    assert nerf(source, out, steps=3, test_every=4).summary["num_compared"] == 4
    return out


def images(folder: Path) -> dict[str, bytes]:
    found = {path.name: path.read_bytes() for path in sorted(folder.glob("*.png"))}
    assert found and not (folder / "units").exists()
    return found


@pytest.mark.parametrize("output", ["color", "depth", "normals"])
def test_threads_draw_the_same_images(splats: Path, tmp_path: Path, output: str) -> None:
    render(splats, tmp_path / "here", output=output, **FOUR)
    seen = []
    done = render(splats, tmp_path / "there", progress=seen.append, executor="threads", output=output, **FOUR)
    assert images(tmp_path / "here") == images(tmp_path / "there")
    assert done.num_frames == 4 and done.frames_per_s > 0 and seen[-1].done == 4


def test_threads_write_the_same_animation(splats: Path, tmp_path: Path) -> None:
    for name, executor in (("here", None), ("there", "threads")):
        render(splats, tmp_path / f"{name}.gif", executor=executor, **FOUR)
    assert (tmp_path / "here.gif").read_bytes() == (tmp_path / "there.gif").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["here.gif", "there.gif"]


def test_an_interrupted_rendering_continues(
    splats: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    render(splats, tmp_path / "whole", **FOUR)
    real, count = image_units.in_bytes, [0]

    def interrupted(image: np.ndarray) -> np.ndarray:
        count[0] += 1
        if count[0] == 3:
            raise KeyboardInterrupt
        return real(image)

    monkeypatch.setattr(image_units, "in_bytes", interrupted)
    with pytest.raises(KeyboardInterrupt):
        render(splats, tmp_path / "out", executor="threads", **FOUR)
    num_left = len(list((tmp_path / "out" / "units").glob("*.npz")))
    count[0] = 10
    render(splats, tmp_path / "out", executor="threads", **FOUR)
    assert num_left >= 2 and count[0] == 14 - num_left
    assert images(tmp_path / "out") == images(tmp_path / "whole")


def test_another_field_under_the_same_name_is_drawn(splats: Path, tmp_path: Path) -> None:
    file = tmp_path / "splat.ply"
    file.write_bytes(splats.read_bytes())
    render(file, tmp_path / "out", executor="threads", **FOUR)
    before = images(tmp_path / "out")
    write_gaussians(file, replace(scene(), means_in_world=-scene().means_in_world))
    render(file, tmp_path / "out", executor="threads", **FOUR)
    assert not before.items() & images(tmp_path / "out").items()


@in_whole_run
def test_a_cluster_draws_the_same_images(trained: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    render(trained, tmp_path / "here", **FOUR)
    given = ["render", str(trained), str(tmp_path / "there"), "--frames", "4", "--width", "40"]
    main([*given, "--cluster", "local:2", "--no-shared-folder"])
    assert images(tmp_path / "here") == images(tmp_path / "there")


@in_whole_run
def test_a_cluster_compares_the_same_views(source: Path, trained: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    out = tmp_path / "out"
    nerf(source, out, steps=3, test_every=4, cluster="local:2", shared_folder=False)
    assert images(out / "test") == images(trained / "test")
    mine, wanted = (json.loads((folder / "metrics.json").read_text())["views"] for folder in (out, trained))
    for one, other in zip(mine, wanted, strict=True):
        assert one.pop("render_s") > 0 and other.pop("render_s") > 0
        assert one == other


@pytest.mark.usefixtures("unchecked")
def test_views_that_the_time_does_not_allow_are_not_rendered_in_groups() -> None:
    from fields_scenes import views

    from epipole.pipelines.fields.held_out import in_time

    class Two:
        num_at_once = 2

        def __init__(self) -> None:
            self.groups: list[list[str]] = []

        def render(self, group: list) -> None:
            self.groups.append([view.name for view in group])

    workers, said = Two(), list[str]()
    found = in_time(views(), FieldOptions(steps=1), lambda view: view.name, lambda *_: None, said, workers)
    assert [len(group) for group in workers.groups] == [2] * 7 and not said
    assert [name for _, name in found] == [view.name for view in views()]
    workers = Two()
    found = in_time(
        views(), FieldOptions(time="0.000001s"), lambda view: view.name, lambda *_: None, said, workers
    )
    assert workers.groups == [["00.png", "13.png"]] and said[0].startswith("only 2 of 14")
