"""A reconstruction says how much of the images has no ray by the camera that was given."""

from types import SimpleNamespace

import numpy as np
import pytest

from epipole.cameras import Camera
from epipole.image.pixels_without_ray import pixels_without_ray
from epipole.pipelines.sfm import notes
from epipole.pipelines.sfm.config import MapperConfig

SOUND = Camera("OPENCV", 640, 480, [520.0, 520.0, 320.0, 240.0, 0.1, -0.05, 0.0, 0.0])
FOLDED = Camera("OPENCV", 640, 480, [520.909, 521.007, 325.141, 249.702, 0.2312, -0.7849, -0.0033, -0.0001])
"""TUM's freiburg2 with its k3 left out."""


@pytest.mark.usefixtures("unchecked")
def test_cameras_that_images_were_registered_with_are_looked_at(monkeypatch):
    monkeypatch.setattr(notes, "gps_notes", lambda *_: [])
    for registered, count in (([True, True, True], 1), ([True, True, False], 0)):
        model = SimpleNamespace(
            cameras=[SOUND, FOLDED],
            camera_of_image=np.array([0, 0, 1]),
            is_registered=lambda registered=registered: np.array(registered),
        )
        mapped = SimpleNamespace(agreements=[], models=[model], pose_fits=(None,), notes=())
        images = SimpleNamespace(
            names=(), known_poses=None, cameras=SimpleNamespace(is_constant=np.array([True, True]))
        )
        without_conflicts = {
            "contradicting": SimpleNamespace(is_conflicting=np.zeros(0, bool)),
            "conflicts": (),
        }
        solution = SimpleNamespace(mapped=mapped, images=images, focals={}, **without_conflicts)
        found = notes.warnings_of(solution, MapperConfig())
        assert len(found) == count
        for words in found:
            assert words.startswith(
                f"model 0, camera 1: {pixels_without_ray(FOLDED).mean():.1%} of the image"
            )


def test_large_images_are_looked_at_coarsely():
    large = FOLDED.scaled_to(4800, 3600)
    small_share, fraction = (pixels_without_ray(camera).mean() for camera in (FOLDED, large))
    assert abs(fraction - small_share) < 0.02 and pixels_without_ray(SOUND.scaled_to(4800, 3600)) is None
    pixels = np.argwhere(~pixels_without_ray(large)[::37, ::41])[:, ::-1] * (41.0, 37.0)
    assert np.isfinite(large.unproject(pixels)).all()
