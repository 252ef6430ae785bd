"""A time for the training bounds what is rendered afterwards, too: fewer views, and that is said."""

import json
from dataclasses import replace
from shutil import copytree

import numpy as np
import pytest
from fields_scenes import CAMERA, camera, views

from epipole import nerf, splat
from epipole.cameras import Camera
from epipole.pipelines.fields import held_out
from epipole.pipelines.fields.comparison import compare_fields
from epipole.pipelines.fields.config import FieldOptions


class Slow:
    """Renders a pixel in a millisecond, by a clock of its own."""

    background = np.ones(3, np.float32)

    def __init__(self, monkeypatch):
        self.now, self.fixed_s, self.sizes = 0.0, 0.0, []
        monkeypatch.setattr(held_out, "perf_counter", lambda: self.now)

    def render_counted(self, view):
        self.now += self.fixed_s + 1e-3 * view.camera.width * view.camera.height
        self.sizes.append((view.camera.width, view.camera.height))
        return view.over(self.background), 7


def test_as_many_views_are_rendered_as_the_time_allows(monkeypatch):
    slow, said, reports = Slow(monkeypatch), list[str](), []
    each_s = 1e-3 * CAMERA.width * CAMERA.height

    def rendered(options):
        found = held_out.in_time(
            views(), options, slow.render_counted, lambda *report: reports.append(report), said
        )
        assert all(count == 7 and image.shape == (48, 64, 3) for _, (image, count) in found)
        return [view.name for view, _ in found]

    wanted = FieldOptions(time=f"{3.5 * each_s / held_out.RENDER_FRACTION:.3f}s")
    assert rendered(wanted) == ["00.png", "06.png", "13.png"]
    assert said[0].startswith("only 3 of 14 views were rendered and compared: a view takes about 3.1 s")
    assert reports == [(0, 14), (1, 14), (2, 14), (3, 14), (3, 3)]
    assert rendered(FieldOptions(time="1s")) == ["00.png"]
    said.clear()
    for options in (FieldOptions(steps=1), FieldOptions(time="1h")):
        assert len(rendered(options)) == 14 and not said
    assert held_out.in_time([], wanted, slow.render_counted, lambda *_: None, said) == []


def test_every_beginning_of_the_rows_is_spread_over_all():
    for count in (0, 1, 2, 3, 14, 97):
        order = held_out.rows_of_two_passes(count)
        assert sorted(order) == list(range(count))
    for k in (2, 3, 5, 9, 17, 33):
        assert max(np.diff(sorted(held_out.rows_of_two_passes(97)[:k]))) <= 96 / (k - 1) + 2


def test_how_long_a_view_takes_is_known_from_smaller_ones(monkeypatch):
    slow = Slow(monkeypatch)
    monkeypatch.setattr(held_out, "RAYS_OF_THREAD", 100)
    monkeypatch.setattr(held_out, "num_threads", lambda: 1)
    each_s = 1e-3 * CAMERA.width * CAMERA.height
    assert held_out.seconds_of_view(slow, views()[0]) == pytest.approx(each_s, rel=0.01)
    assert max(width * height for width, height in slow.sizes) < 200
    line = replace(
        views()[0], image=np.zeros((1, 64, 3), np.uint8), camera=Camera("PINHOLE", 64, 1, CAMERA.params)
    )
    assert held_out.seconds_of_view(slow, line) == pytest.approx(0.064)
    slow.fixed_s = 10.0  # whatever the size
    assert held_out.seconds_of_view(slow, views()[0]) == pytest.approx(10.0 + each_s, rel=0.01)


def test_a_view_on_the_way_that_would_take_too_long_is_not_begun(monkeypatch):
    slow = Slow(monkeypatch)
    monkeypatch.setattr(held_out, "RAYS_OF_THREAD", 100)
    monkeypatch.setattr(held_out, "num_threads", lambda: 1)
    assert held_out.probed(slow, views(), 5.0) is None and slow.now < 0.5
    assert held_out.probed(slow, views(), 10.0) > 60
    assert held_out.probed(slow, [], 10.0) is None


def test_fewer_views_are_compared_in_little_time(source, tmp_path, monkeypatch):
    monkeypatch.setattr(held_out, "RENDER_FRACTION", 0.0)
    found = nerf(source, tmp_path / "out", time="0.2s", test_every=4, kind="grid")
    assert found.summary["num_test"] == 4 and found.summary["num_compared"] == 1
    assert "1 of 4 views were rendered" in found.summary["warnings"][0]
    assert [path.name for path in (found.out / "test").iterdir()] == ["images_00.png"]
    assert "images/00.png" in (found.out / "report.html").read_text()
    whole = splat(source, tmp_path / "whole", steps=1, test_every=4, max_gaussians=50)
    assert whole.summary["num_compared"] == 4 and not whole.warnings


def test_a_comparison_renders_no_view_of_the_field_twice(source, tmp_path, monkeypatch):
    rendered = []
    timed = held_out.timed

    def counting(renderer, view):
        rendered.append((type(renderer).__name__, view.name))
        return timed(renderer, view)

    monkeypatch.setattr(held_out, "timed", counting)
    monkeypatch.setattr(held_out, "RENDER_FRACTION", 0.0)
    monkeypatch.setattr(held_out, "seconds_of_view", lambda renderer, view: 1.0)
    found = compare_fields(source, tmp_path / "out", time="0.2s", test_every=4, kind="grid")
    assert sorted(rendered) == [("SplatTrainer", "images/00.png"), ("WrittenField", "images/00.png")]
    given = json.loads((found.out / "compare.json").read_text())
    assert given["views"] == 1 and any("1 of 4 views" in words for words in found.warnings)
    assert given["nerf"]["frames_s"] > 0 and given["nerf"]["queries"] > 0.5


def test_files_of_like_names_are_the_same_where_few_views_are_rendered(source, tmp_path, monkeypatch):
    monkeypatch.setattr(held_out, "RENDER_FRACTION", 0.0)
    copytree(source, tmp_path / "scene")
    frames = json.loads((source / "transforms.json").read_text())["frames"]
    (tmp_path / "scene" / "x").mkdir()
    for frame, name in zip(frames[:2], ("x/y.png", "x_y.png")):
        (tmp_path / "scene" / frame["file_path"]).rename(tmp_path / "scene" / name)
        frame["file_path"] = name
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(camera() | {"frames": frames}))
    out = tmp_path / "out"
    compare_fields(tmp_path / "scene", out, time="0.2s", test="x/y.png,x_y.png", kind="grid")
    for folder in (out / "images", out / "nerf" / "test", out / "splat" / "test"):
        assert [path.name for path in folder.iterdir()] == ["x_y.png.png"], folder
