"""The 3D payload, the view from above and the table of pictures, read back."""

import base64
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from report_ring import FOCAL_PX, HEIGHT, WIDTH, empty_model, ring_model

from epipole.geometry import Similarity3
from epipole.pipelines.sfm.page import render_report
from epipole.pipelines.sfm.page_content import ReportContent
from epipole.report.pictures import MAX_FEATURES
from epipole.report.plan import draw_plan
from epipole.report.space import space_payload, stage_of
from epipole.scene import Reconstruction


def decoded(payload: dict) -> np.ndarray:
    steps = np.frombuffer(base64.b64decode(payload["xyz"]), "<u2").reshape(-1, 3)
    return np.array(payload["low"]) + steps / 65535 * np.array(payload["span"])


def table_of(content: ReportContent) -> str:
    return re.search(
        r'<table class="pictures sortable">.*?</table>', render_report(content), re.DOTALL
    ).group()


def test_points_come_back_within_one_step(model: Reconstruction) -> None:
    payload = space_payload(model)
    assert payload["count"] == len(model.points)
    step = max(payload["span"]) / 65535
    np.testing.assert_allclose(decoded(payload), model.points.xyz_in_world, atol=0.51 * step)
    rgb = np.frombuffer(base64.b64decode(payload["rgb"]), np.uint8).reshape(-1, 3)
    np.testing.assert_array_equal(rgb, model.points.rgb)


def test_many_points_are_sampled_and_far_ones_left_out(model: Reconstruction) -> None:
    xyz = model.points.xyz_in_world.copy()
    xyz[0], xyz[1] = (1e6, 0, 0), np.nan
    far = replace(model, points=replace(model.points, xyz_in_world=xyz))
    assert space_payload(far)["count"] == len(xyz) - 2
    few = space_payload(far, max_points=50)
    assert few["count"] == len(decoded(few)) == 50
    assert few["xyz"] == space_payload(far, max_points=50)["xyz"]


def test_frustum_corners_project_to_the_pictures_corners(model: Reconstruction) -> None:
    payload, placed = space_payload(model), np.flatnonzero(model.is_registered())
    assert payload["image"] == placed.tolist()
    for row, image in enumerate(placed):
        center, corners = np.array(payload["centers"][row]), np.array(payload["corners"][row]).reshape(4, 3)
        in_cam = model.cams_from_world()[image].apply(center + 0.7 * corners)
        pixels = in_cam[:, :2] / in_cam[:, 2:] * FOCAL_PX + (319.5, 239.5)
        expected = [[-0.5, -0.5], [WIDTH - 0.5, -0.5], [WIDTH - 0.5, HEIGHT - 0.5], [-0.5, HEIGHT - 0.5]]
        np.testing.assert_allclose(pixels, expected, atol=0.2)


def test_stage_scales_with_the_world(model: Reconstruction) -> None:
    bigger = model.transformed(Similarity3(np.float64(100.0), np.eye(3), np.array([5.0, 6.0, 7.0])))
    before, after = stage_of(model), stage_of(bigger)
    assert after.radius == pytest.approx(100 * before.radius)
    np.testing.assert_allclose(after.focus, 100 * before.focus + (5, 6, 7))


def test_stage_of_nothing_and_of_one_camera() -> None:
    assert stage_of(empty_model(0)).radius == 1.0
    lonely = ring_model(1, num_points=0, num_absent=0)
    assert space_payload(lonely)["count"] == 0
    assert space_payload(lonely)["size"] == pytest.approx(0.15)


def test_view_from_above_keeps_shape(model: Reconstruction) -> None:
    root = ElementTree.fromstring(draw_plan(model, "m"))
    groups = [e for e in root.iter("g") if e.attrib.get("class") == "cam"]
    drawn = np.array([re.findall(r"[\d.]+", g.attrib["transform"]) for g in groups], float)
    centers = model.camera_centers_in_world()[model.is_registered()][:, :2] * (1, -1)
    scale = np.ptp(drawn[:, 0]) / np.ptp(centers[:, 0])
    np.testing.assert_allclose(drawn - drawn[0], scale * (centers - centers[0]), atol=0.15)
    assert [g.find("title").text for g in groups] == list(model.images.name[:10])
    assert {e.text for e in root.iter("text")} >= {"x (m)", "y (m)", "0"}


def test_wedges_point_to_where_the_cameras_look(model: Reconstruction) -> None:
    root = ElementTree.fromstring(draw_plan(model, "m"))
    for group in root.iter("g"):
        values = [float(v) for v in re.findall(r"-?[\d.]+", group.find("path").attrib["d"])]
        x, y = map(float, re.findall(r"[\d.]+", group.attrib["transform"]))
        middle = np.array(values[2:6]).reshape(2, 2).mean(axis=0)
        centre_of_ring = np.array([0.5 * (52 + 608), 0.5 * (12 + 476)])
        toward = centre_of_ring - (x, y)
        cosine = middle @ toward / np.linalg.norm(middle) / np.linalg.norm(toward)
        assert cosine > 0.99


def test_sequence_breaks_where_a_picture_is_missing() -> None:
    ring = ring_model(6, num_points=80, num_absent=0)
    translation = ring.frames.rig_from_world.translation.copy()
    translation[2] = np.nan
    lost = replace(ring.frames.rig_from_world, translation=translation)
    gap = replace(ring, frames=replace(ring.frames, rig_from_world=lost))
    line = re.search(r'class="sequence" d="([^"]*)"', draw_plan(gap, "m")).group(1)
    assert re.sub(r"[^ML]", "", line) == "MLMLL"


def test_no_view_from_above_without_cameras() -> None:
    assert draw_plan(empty_model(3), "m") == ""


def test_table_lists_absent_pictures_first_with_their_reason(content: ReportContent) -> None:
    table = table_of(content)
    names = re.findall(r'<th scope="row" class="name">([^<]*)</th>', table)
    assert names == [*content.reconstruction.images.name[10:], *content.reconstruction.images.name[:10]]
    assert table.count("not placed: too few matches with any placed picture (7, needed 15)") == 2
    assert "Model" not in table
    assert "Model" in table_of(replace(content, other_components=(3,)))


def test_dots_lie_on_the_inliers(content: ReportContent) -> None:
    name = "ring/picture_000.jpg"
    one = replace(content, image_rows=content.image_rows[:1])
    dots = re.search(r'class="dots" d="([^"]*)"', table_of(one)).group(1)
    drawn = np.array(re.findall(r"M([\d.]+) ([\d.]+)h0", dots), float)
    np.testing.assert_allclose(drawn, content.inliers[name] * (320, 240), atol=0.06)


def test_dots_are_capped_and_bad_thumbnails_left_out(content: ReportContent) -> None:
    row, name = content.image_rows[0], content.image_rows[0].name
    many = replace(content, image_rows=(row,), inliers={name: np.random.default_rng(0).random((5000, 2))})
    assert table_of(many).count("h0") == 2 * MAX_FEATURES
    broken = replace(content, image_rows=(row,), thumbnails={name: b"not a picture"})
    assert "<image" not in table_of(broken)
