"""From options and files to one scale: every kind of anchor, alone and together, on adjusted rings."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from anchored_rings import ring

from epipole.config import AnchorOptions
from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.geometry import Rigid3
from epipole.scale import anchor_model, position_covariance, views_of_model
from epipole.scale.anchor_views import positions_at
from epipole.synthetic import SyntheticScene, render
from epipole.synthetic.markers import chessboard_sheet, tag_sheet

ENDS = np.array(
    [[[-0.5, 0, 0.1], [0.5, 0.1, 0]], [[0, -0.6, 0], [0.1, 0.5, 0.2]], [[0.3, 0, -0.4], [0, 0.2, 0.5]]]
)


@pytest.fixture(scope="module")
def known():
    return ring()


def nothing(_):
    return None


def anchored(known, options, image=nothing):
    found = anchor_model(views_of_model(known.model, image), options)
    return found, found.scale.scale / known.meters - 1.0


def write(folder, text):
    (folder / "a.txt").write_text(text)
    return folder / "a.txt"


def test_lengths_one_of_them_wrong(known, tmp_path, rng):
    text = "".join(
        known.length(ends, (0, 5, 9, 15), f"L{n}", noise=rng, meters=9.0 if n == 1 else None)
        for n, ends in enumerate(ENDS)
    )
    found, off = anchored(known, AnchorOptions(lengths=write(tmp_path, text)))
    assert abs(off) < 2.5 * found.scale.relative_sigma < 0.02
    assert found.scale.in_words().startswith("meters, from 2 lengths: known to ")
    assert [w[:22] for w in found.scale.warnings()] == ["length L1 is ignored: "]
    assert np.array_equal(found.world_from_model.rotation, np.eye(3)) and found.positions is None


def test_lengths_that_tell_nothing_say_why(known, tmp_path):
    for text, words in (
        (known.length(ENDS[0], (4,)), "seen in 1 posed image: two"),
        (known.length(ENDS[0], (4, 7)).replace("ring_0007", "absent"), "absent.jpg has no pose"),
        (
            known.length(ENDS[0], (0, 6, 12)) + known.length(ENDS[1], (0, 6, 12), "M", 5.0),
            "contradict each other",
        ),
        (known.length(np.zeros((2, 3)), (0, 6), meters=1.0), "ends coincide|too uncertain"),
    ):
        with pytest.raises(DegenerateGeometryError, match=words):
            anchored(known, AnchorOptions(lengths=write(tmp_path, text)))


def test_measured_places_give_the_world_too(known, tmp_path, rng):
    centers = known.truth.camera_centers_in_world()
    names = known.truth.images.name
    text = "".join(
        f"{n} {x} {y} {z}\n"
        for n, (x, y, z) in zip(names, centers + 0.01 * rng.normal(size=(24, 3)), strict=True)
    )
    found, off = anchored(known, AnchorOptions(positions=write(tmp_path, text), positions_sigma_m=0.01))
    assert abs(off) < 3 * found.scale.relative_sigma
    there = known.model.transformed(found.world_from_model).camera_centers_in_world()
    assert np.abs(there - centers).max() < 0.05 and np.isfinite(found.positions.positions).all()
    line = "".join(f"{n} {i} {i} 0\n" for i, n in enumerate(names))
    with pytest.raises(DegenerateGeometryError, match="measured positions"):
        anchored(known, AnchorOptions(positions=write(tmp_path, line)))


def test_places_by_time_and_odometry(known, tmp_path):
    centers = known.truth.camera_centers_in_world()
    text = "".join(f"{0.5 * n} {x} {y} {z}\n" for n, (x, y, z) in enumerate(centers))
    found, off = anchored(known, AnchorOptions(positions=write(tmp_path, text), positions_sigma_m=0.01))
    assert abs(off) < 0.01 and found.positions.num_measured == 24
    wheels = text.replace("\n", " 0 0 0 1\n")
    found, off = anchored(known, AnchorOptions(odometry=write(tmp_path, wheels)))
    assert abs(off) < 2 * found.scale.relative_sigma and "of odometry" in found.scale.in_words()


@pytest.mark.parametrize("kind", ["T_cam_imu", "T_BS"])
def test_odometry_of_a_point_beside_the_camera(known, tmp_path, kind):
    """Half a meter behind a camera that looks inward: the wheels went further round."""
    mounting = Rigid3(np.eye(3), np.array([0.0, 0.1, -0.5]))  # camera_from_body
    positions = known.truth.cams_from_world().inverse()
    centers = positions.translation + positions.rotation @ mounting.translation
    text = "".join(f"{0.5 * n} {x} {y} {z} 0 0 0 1\n" for n, (x, y, z) in enumerate(centers))
    matrix = (mounting if kind == "T_cam_imu" else mounting.inverse()).as_matrix()
    content = {
        kind: matrix.tolist()
        if kind == "T_cam_imu"
        else {"rows": 4, "cols": 4, "data": matrix.ravel().tolist()}
    }
    (tmp_path / "sensor.yaml").write_text(json.dumps(content))
    wheels = {"odometry": write(tmp_path, text), "odometry_sigma": 0.003}
    found, off = anchored(known, AnchorOptions(**wheels, odometry_mounting=tmp_path / "sensor.yaml"))
    assert abs(off) < 2 * found.scale.relative_sigma < 0.02
    _, without = anchored(known, AnchorOptions(**wheels))
    assert abs(without) > 0.05


@pytest.mark.parametrize("kind", ["tags", "board", "nothing"])
def test_objects_in_rendered_pictures(known, kind):
    camera = known.truth.cameras[0].scaled_to(480, 360)
    cams = known.truth.cams_from_world()
    axes = (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)
    things = chessboard_sheet(6, 4, 0.15, (0.0, 0.0, 0.0), *axes)
    if kind == "tags":
        things = tag_sheet(1, 0.4, (0.0, -0.4, 0.0), *axes) + tag_sheet(2, 0.4, (0.0, 0.4, 0.0), *axes)
    scene = SyntheticScene.of(things, light=(1.0, 0.0, 0.3))
    size = {"tag_size_m": 0.4} if kind != "board" else {"board": "6x4", "square_m": 0.15}

    def image(row):
        if row not in (0, 2, 22):
            return None
        rendered = render(scene, camera, cams[row], noise_sigma=2.0, seed=row)
        return cv2.cvtColor(rendered.rgb, cv2.COLOR_RGB2GRAY)

    views = views_of_model(known.model, image)
    # The images are smaller than those of the model.
    object.__setattr__(views, "cameras", (camera,) * len(views))
    if kind == "nothing":
        with pytest.raises(DegenerateGeometryError, match="no 36h11 tag was detected"):
            anchor_model(views, AnchorOptions(tag_size_m=0.4))
        return
    found = anchor_model(views, AnchorOptions(**size)).scale
    assert abs(found.scale / known.meters - 1.0) < 2.5 * found.relative_sigma < 0.02
    assert found.in_words().startswith(
        "meters, from 2 tags" if kind == "tags" else "meters, from the board of 6x4"
    )


def test_covariance_of_a_place_is_that_of_its_errors(known):
    """Noise of half a pixel, found from the residuals; the ring's errors are near to what is told."""
    moved = known.truth
    away = []
    for image in range(24):
        covariance = position_covariance(moved, image)
        assert (np.linalg.eigvalsh(covariance) > 0).all()
        away.append(np.sqrt(np.trace(covariance[:3, :3])))
    assert 1e-4 < np.median(away) < 1e-2


def test_places_between_instants():
    known_s, positions = np.array([0.0, 1.0, 2.0, 9.0]), np.arange(12.0).reshape(4, 3)
    found = positions_at(known_s, positions, np.array([0.5, 2.0, 5.0, 9.5]))
    np.testing.assert_allclose(found[:2], [[1.5, 2.5, 3.5], [6, 7, 8]])
    assert np.isnan(found[2:]).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"board": "9by6", "square_m": 0.1}, "9x6"),
        ({"board": "9x6"}, "square_m"),
        ({"tag_size_m": -1.0}, "tag_size_m"),
        ({"tag_family": "35h9"}, "unknown dictionary"),
        ({"size_sigma": 2.0}, "size_sigma is a fraction"),
        ({"odometry_mounting": Path("sensor.yaml")}, "give odometry, too"),
    ],
)
def test_options_that_make_no_sense(options, words):
    with pytest.raises(ConfigError, match=words):
        AnchorOptions(**options)
