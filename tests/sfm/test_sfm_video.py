"""A video of the rendered courtyard becomes a model whose cameras stand where they stood."""

import cv2
import numpy as np
import pytest
from photographs import CAMERA, HEIGHT, WIDTH

from epipole import reconstruct
from epipole.geometry import Rotation3, align_points
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.synthetic import courtyard, courtyard_views, render
from whole import in_whole_run

NUM_FRAMES, FPS = 6, 4.0


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """Six frames along thirty degrees of the arc, as motion JPEG, without any EXIF."""
    path = tmp_path_factory.mktemp("film") / "courtyard.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), FPS, (WIDTH, HEIGHT))
    views = courtyard_views(24)[np.arange(6, 6 + NUM_FRAMES)]
    for n in range(NUM_FRAMES):
        image = render(courtyard(), CAMERA, views[n], noise_sigma=1.5, seed=n)
        writer.write(cv2.cvtColor(image.rgb, cv2.COLOR_RGB2BGR))
    writer.release()
    return path, views


@pytest.fixture(scope="module")
def result(film, tmp_path_factory):
    return reconstruct(film[0], tmp_path_factory.mktemp("model") / "out")


def test_every_frame_is_placed_in_order_with_its_time(result) -> None:
    assert result.model.images.name == tuple(f"frame_{n:06d}.jpg" for n in range(NUM_FRAMES))
    assert result.model.is_registered().all() and result.reasons == {}
    np.testing.assert_allclose(result.model.frames.timestamp_s, np.arange(NUM_FRAMES) / FPS, atol=1e-3)
    assert not result.summary["is_metric"]
    assert "<h1>courtyard</h1>" in (result.out / "report.html").read_text(encoding="utf-8")


def test_cameras_stand_where_they_stood(result, film) -> None:
    """Up to a similarity: to a hundredth of the path's length, and half a degree."""
    truth, found = film[1], result.model.cams_from_world()
    truth_from_found = align_points(found.centers(), truth.centers())
    error = np.linalg.norm(truth_from_found.apply(found.centers()) - truth.centers(), axis=1)
    length = np.linalg.norm(np.diff(truth.centers(), axis=0), axis=1).sum()
    assert error.max() < 0.01 * length
    rotated = Rotation3(truth.rotation @ truth_from_found.rotation @ np.swapaxes(found.rotation, 1, 2))
    assert np.rad2deg(rotated.angle_rad()).max() < 0.5


def test_the_lens_is_found_without_exif(result) -> None:
    """All frames share one camera, whose focal length a video does not tell."""
    assert len(result.model.cameras) == 1
    assert result.model.cameras[0].focal_px == pytest.approx(CAMERA.focal_px, rel=0.03)


@in_whole_run
def test_frames_of_a_video_that_ends_early_are_enough(film, tmp_path) -> None:
    """A film cut off in its last third still gives the frames before."""
    data = film[0].read_bytes()
    (tmp_path / "cut.avi").write_bytes(data[: int(0.75 * len(data))])
    config = ReconstructConfig(max_frames=5)
    cut = reconstruct(tmp_path / "cut.avi", tmp_path / "out", config)
    assert 3 <= int(cut.model.is_registered().sum()) <= 5
