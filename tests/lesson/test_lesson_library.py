"""The calls of the library that pages show: all of them run."""

import html
import inspect
import re
import types

import numpy as np
import pytest
from tests.lesson.test_lesson_bundle import CAMERA, disturbed, observed, problem_of

import epipole
from epipole.geometry import Rigid3, Rotation3, epipolar
from epipole.lesson.pages import PAGES, lesson_pages
from epipole.lesson.scenes import ring
from whole import IS_WHOLE

JOBS = ("reconstruct", "slam", "splat", "nerf", "render")
WITH_SCRIPTS = [number for number, page in enumerate(PAGES, 1) if page.scripts]


def only_bound(job):
    """A job that is not run, but refuses arguments that it does not have."""

    def called(*given, **named):
        inspect.signature(job).bind(*given, **named)
        return types.SimpleNamespace(warnings=(), summary={"psnr": 30.0})

    return called


def given() -> dict:
    """What the calls are about."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -1.5, 4], [2, 1.5, 7], (60, 3))
    cam2_from_cam1 = Rigid3(Rotation3.exp(np.array([0.02, 0.1, 0.0])).matrix, np.array([-0.8, 0.0, 0.1]))
    cams = Rigid3.identity(1)
    cams_from_world = Rigid3(
        np.concatenate([cams.rotation, cam2_from_cam1.rotation[None]]),
        np.concatenate([cams.translation, cam2_from_cam1.translation[None]]),
    )
    pixels1, pixels2 = (
        CAMERA.project(pose.apply(points)) + rng.normal(size=(60, 2)) for pose in cams_from_world
    )
    rays1, rays2 = CAMERA.unproject(pixels1), CAMERA.unproject(pixels2)
    scene = ring()
    return {
        "K": CAMERA.K,
        "E": epipolar.essential_from_cam2_from_cam1(cam2_from_cam1),
        "cam2_from_cam1": cam2_from_cam1,
        "slam_camera": epipole.SlamCamera(CAMERA),
        "frame": epipole.Frame(0.0, np.zeros((480, 640), np.uint8)),
        "camera": CAMERA,
        "cams_from_world": cams_from_world,
        "points_in_world": points,
        "pixels": np.stack([pixels1, pixels2]),
        "pixels1": pixels1,
        "pixels2": pixels2,
        "rays_of_point": np.stack([rays1[0], rays2[0]]),
        "rays1": rays1,
        "rays2": rays2,
        "problem": problem_of(*disturbed(scene, 0.1), *observed(scene, 70.0, 0.5)),
    }


@pytest.mark.parametrize("number", WITH_SCRIPTS if IS_WHOLE else WITH_SCRIPTS[::3])
def test_calls_that_a_page_shows_run(number, monkeypatch):
    for job in JOBS:
        monkeypatch.setattr(epipole, job, only_bound(getattr(epipole, job)))
    names = [name for name in lesson_pages() if name.startswith(f"{number:02d}_")]
    blocks = [re.findall(r"<pre[^>]*><code>(.*?)</code></pre>", lesson_pages()[name], re.S) for name in names]
    assert blocks[0] and blocks[0] == blocks[1]
    for block in blocks[0]:
        exec(compile(html.unescape(block), names[0], "exec"), given())
