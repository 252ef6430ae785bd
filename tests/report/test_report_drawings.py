"""The 3D payload, the view from above and the table of images, read back."""

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from report_ring import FOCAL_PX, HEIGHT, WIDTH, empty_model, ring_model

from epipole.geometry import Similarity3
from epipole.pipelines.sfm.page.content import ReportContent
from epipole.pipelines.sfm.page.page import render_report
from epipole.pipelines.sfm.page.pairs import MAX_PAIRS_SHOWN, pair_lines
from epipole.report.images import MAX_FEATURES
from epipole.report.plan import draw_plan
from epipole.report.space import SpaceData, space_data
from epipole.report.space_model import scene_of_model, stage_of
from epipole.robust import point_covariances
from epipole.scene import Georeference, Reconstruction
from epipole.scene.point_accuracy import covariances_of_points, pixel_noise


def data_of(model: Reconstruction, most: int | None = None) -> SpaceData:
    return space_data(scene_of_model(model, title="ring", unit=""), most)


def decoded(data: SpaceData) -> np.ndarray:
    rows = np.frombuffer(data.blocks["points-0"], "<f4").reshape(-1, 4)
    return rows[:, :3] + np.array(data.numbers["origin"])


def table_of(content: ReportContent) -> str:
    return re.search(r'<table class="images sortable">.*?</table>', render_report(content), re.DOTALL).group()


def by_position(xyz: np.ndarray, *columns: np.ndarray) -> list[np.ndarray]:
    order = np.lexsort(xyz.T)
    return [column[order] for column in (xyz, *columns)]


def test_points_come_back_in_an_order_drawn_at_random(model: Reconstruction) -> None:
    data = data_of(model)
    assert data.numbers["points"][0]["count"] == len(model.points)
    rgb = np.frombuffer(data.blocks["points-0"], np.uint8).reshape(-1, 16)[:, 12:15]
    found, colors = by_position(decoded(data), rgb)
    wanted, wanted_rgb = by_position(model.points.xyz_in_world, model.points.rgb)
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    np.testing.assert_array_equal(colors, wanted_rgb)
    assert (decoded(data) != model.points.xyz_in_world).any()
    assert data.blocks == data_of(model).blocks


def test_a_map_of_a_country_keeps_its_millimeters(model: Reconstruction) -> None:
    far = model.transformed(Similarity3(np.float64(1.0), np.eye(3), np.array([4e5, 5e6, 100.0])))
    found, wanted = (by_position(xyz)[0] for xyz in (decoded(data_of(far)), far.points.xyz_in_world))
    np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_many_points_are_sampled_and_those_without_a_place_left_out(model: Reconstruction) -> None:
    xyz = model.points.xyz_in_world.copy()
    xyz[1] = np.nan
    some = replace(model, points=replace(model.points, xyz_in_world=xyz))
    assert data_of(some).numbers["points"][0]["count"] == len(xyz) - 1
    few = data_of(some, 50)
    assert few.numbers["points"][0]["count"] == len(decoded(few)) == 50
    assert len(few.blocks["covariances-0"]) == 50 * 24 and len(few.blocks["values-0"]) == 50 * 4


def test_measures_come_in_steps_of_their_range(model: Reconstruction) -> None:
    data = data_of(model)
    steps = np.frombuffer(data.blocks["values-0"], "<u2").reshape(-1, 2)
    error, seen = data.numbers["points"][0]["measures"]
    assert error["unit"] == "px" and seen["isAtLeast"]
    tracks = np.diff(model.tracks.offsets)
    found = seen["low"] + (seen["high"] - seen["low"]) * steps[:, 1] / 65534
    assert np.array_equal(np.sort(np.rint(found)), np.sort(tracks))


def test_covariances_are_those_of_the_triangulation(model: Reconstruction) -> None:
    noise = pixel_noise(model)
    found = covariances_of_points(model, noise)
    registered = np.flatnonzero(model.is_registered())
    seen = np.zeros((len(registered), len(model.points)), bool)
    point = np.repeat(np.arange(len(model.points)), np.diff(model.tracks.offsets))
    for row, image in enumerate(registered):
        seen[row, point[model.tracks.image == image]] = True
    cameras = [model.cameras[int(c)] for c in model.camera_of_image[registered]]
    poses = model.cams_from_world()[registered]
    wanted = point_covariances(poses, cameras, model.points.xyz_in_world, seen, noise)
    # A point whose residuals are larger than the noise is less certain, by their root mean square.
    squared = np.bincount(point, model.reprojection_errors_px() ** 2, minlength=len(model.points))
    own = np.sqrt(squared / (2 * seen.sum(axis=0) - 3)) / noise
    assert (own < 1).any() and (own > 1).any()
    np.testing.assert_allclose(found, wanted * np.maximum(own, 1.0)[:, None, None] ** 2, rtol=1e-8)


def test_frustum_corners_project_to_the_pictures_corners(model: Reconstruction) -> None:
    data, registered = data_of(model), np.flatnonzero(model.is_registered())
    assert data.numbers["cameras"]["names"] == [model.images.name[image] for image in registered]
    corners = np.frombuffer(data.blocks["camera-corners"], "<f4").reshape(-1, 4, 3)
    centers = np.frombuffer(data.blocks["camera-places"], "<f4").reshape(-1, 3) + data.numbers["origin"]
    for row, image in enumerate(registered):
        in_cam = model.cams_from_world()[image].apply(centers[row] + 0.7 * corners[row])
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
    assert data_of(lonely).numbers["points"][0]["count"] == 0
    assert data_of(lonely).numbers["cameras"]["size"] == pytest.approx(0.12)


def test_view_from_above_keeps_shape(model: Reconstruction) -> None:
    root = ElementTree.fromstring(draw_plan(model, "m"))
    groups = [e for e in root.iter("g") if e.attrib.get("class") == "cam"]
    rendered = np.array([re.findall(r"[\d.]+", g.attrib["transform"]) for g in groups], float)
    centers = model.camera_centers_in_world()[model.is_registered()][:, :2] * (1, -1)
    scale = np.ptp(rendered[:, 0]) / np.ptp(centers[:, 0])
    np.testing.assert_allclose(rendered - rendered[0], scale * (centers - centers[0]), atol=0.15)
    assert [g.find("title").text for g in groups] == list(model.images.name[:10])
    assert {e.text for e in root.iter("text")} >= {"x (m)", "y (m)", "0"}


def test_view_from_above_names_east_and_north_of_a_georeferenced_model(model: Reconstruction) -> None:
    root = ElementTree.fromstring(draw_plan(replace(model, georeference=Georeference(47.0, 8.0, 400.0)), "m"))
    assert {e.text for e in root.iter("text")} >= {"x, east (m)", "y, north (m)"}


def test_wedges_point_to_where_the_cameras_look(model: Reconstruction) -> None:
    root = ElementTree.fromstring(draw_plan(model, "m"))
    for group in root.iter("g"):
        values = [float(v) for v in re.findall(r"-?[\d.]+", group.find("path").attrib["d"])]
        x, y = map(float, re.findall(r"[\d.]+", group.attrib["transform"]))
        middle = np.array(values[2:6]).reshape(2, 2).mean(axis=0)
        center_of_ring = np.array([0.5 * (52 + 608), 0.5 * (12 + 476)])
        toward = center_of_ring - (x, y)
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
    assert table.count("not registered: too few matches with any placed image (7, needed 15)") == 2
    assert "Model" not in table
    assert "Model" in table_of(replace(content, other_components=(3,)))


def test_dots_lie_on_the_inliers(content: ReportContent) -> None:
    name = "ring/picture_000.jpg"
    one = replace(content, image_rows=content.image_rows[:1])
    dots = re.search(r'class="dots" d="([^"]*)"', table_of(one)).group(1)
    rendered = np.array(re.findall(r"M([\d.]+) ([\d.]+)h0", dots), float)
    np.testing.assert_allclose(rendered, content.inliers[name] * (320, 240), atol=0.06)


def test_dots_are_capped_and_bad_thumbnails_left_out(content: ReportContent) -> None:
    row, name = content.image_rows[0], content.image_rows[0].name
    many = replace(content, image_rows=(row,), inliers={name: np.random.default_rng(0).random((5000, 2))})
    assert table_of(many).count("h0") == 2 * MAX_FEATURES
    broken = replace(content, image_rows=(row,), thumbnails={name: b"not an image"})
    assert "<image" not in table_of(broken)


def test_pairs_that_contradict_are_listed_with_both_images(content: ReportContent) -> None:
    lines = pair_lines(content)
    assert len(lines) == MAX_PAIRS_SHOWN < len(content.contradicting)
    assert [line.num_matches for line in lines] == list(range(40, 40 - MAX_PAIRS_SHOWN, -1))
    first = lines[0]
    assert all(image is not None and image.dots.count("M") == 40 for image in first.thumbnails)
    page = render_report(content)
    assert "14 pairs of images have matches" in page and "The 12 with the most matches are shown." in page
    without = render_report(replace(content, contradicting=()))
    assert "Pairs that are not used" in page and "Pairs that are not used" not in without
