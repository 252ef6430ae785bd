"""A small scene of Gaussians, seen from all around."""

from functools import cache

import cv2
import numpy as np

from epipole.cameras import Camera
from epipole.fields.splat.rasterizer import render
from epipole.fields.training_view import TrainingView
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.synthetic import look_at

CAMERA = Camera("PINHOLE", 64, 48, [60.0, 60.0, 31.5, 23.5])
WHITE = np.ones(3, np.float32)


@cache
def scene():
    """Gaussians in the unit ball, colored by their place."""
    rng = np.random.default_rng(7)
    n = 80
    means = rng.normal(size=(n, 3))
    means *= (rng.uniform(0.1, 0.8, n) / np.linalg.norm(means, axis=1))[:, None]
    arrays = (
        *(means, np.log(rng.uniform(0.06, 0.16, (n, 3))), rng.normal(size=(n, 4)), np.full(n, 1.5)),
        np.clip(2.0 * means[:, None] / 0.8, -1.5, 1.5),
    )
    return GaussianCloud(*(np.asarray(array, np.float32) for array in arrays))


@cache
def views(count=14, with_alpha=True):
    """Images of it, with transparency or before white."""
    out = []
    for n in range(count):
        angle, up = 2.399963 * n, -0.7 + 1.4 * (n + 0.5) / count
        position = look_at(2.6 * np.array([np.cos(angle), np.sin(angle), up]), (0, 0, 0))
        rendered = render(scene(), CAMERA, position)
        alpha = rendered.coverage[..., None]
        color = np.divide(rendered.color, alpha, out=np.zeros_like(rendered.color), where=alpha > 0)
        whole = np.concatenate([color, alpha], axis=2) if with_alpha else rendered.over(WHITE)
        image = np.rint(255 * np.clip(whole, 0, 1)).astype(np.uint8)
        out.append(TrainingView(f"{n:02d}.png", image, CAMERA, position))
    return tuple(out)


def frames_of(chosen, folder):
    """Images in a folder, and their entries in a transforms.json."""
    out = []
    for seen in chosen:
        image = cv2.cvtColor(seen.image, cv2.COLOR_RGBA2BGRA)
        (folder / "images").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / "images" / seen.name), image)
        matrix = seen.cam_from_world.inverse().as_matrix() @ np.diag([1.0, -1.0, -1.0, 1.0])
        out.append({"file_path": f"images/{seen.name}", "transform_matrix": matrix.tolist()})
    return out


def camera():
    fx, fy, cx, cy = CAMERA.params
    return {"w": CAMERA.width, "h": CAMERA.height, "fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5}
