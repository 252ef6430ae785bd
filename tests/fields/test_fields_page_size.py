"""The report of a field is a small file, and shows its images as they are."""

import base64
import re
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from epipole.cameras import Camera
from epipole.fields.training_view import TrainingView
from epipole.geometry import Rigid3
from epipole.io.images.rgba import write_png
from epipole.pipelines.fields.images import FieldImages
from epipole.pipelines.fields.page import FieldPage, render_page

CAMERA = Camera("PINHOLE", 800, 600, [700.0, 700.0, 399.5, 299.5])


def photograph(seed: int) -> np.ndarray:
    """As rich as a photograph: noise of all sizes, with the usual fall of the spectrum, and less of color."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(600)[:, None], np.fft.rfftfreq(800)[None])
    noise = rng.normal(size=(1, 600, 800)) + 0.2 * rng.normal(size=(3, 600, 800))
    spectrum = np.fft.rfft2(noise) / np.maximum(frequency, 1e-3)
    gray = np.moveaxis(np.fft.irfft2(spectrum, (600, 800)), 0, 2)
    gray = 128 + 50 * gray / gray.std() + rng.normal(scale=3, size=gray.shape)
    return np.clip(gray, 0, 255).astype(np.uint8)


def test_eight_views_take_a_tenth_of_their_pngs(tmp_path: Path) -> None:
    own = [TrainingView(f"{n}.png", photograph(n), CAMERA, Rigid3.identity()) for n in range(8)]
    for n, view in enumerate(own):
        write_png(tmp_path / "test" / f"{n}.png", photograph(n + 100) // 2 + view.image // 2)
    summary = {
        **{
            "num_gaussians": 1,
            "steps": 1,
            "train_s": 1.0,
            "num_train": 2,
            "num_test": 8,
            "background": "black",
        },
        **{"interrupted": False, "psnr": None, "ssim": None, "timings_s": {"train": 1.0}},
    }
    tables = {"curve": {"rows": [[0.0, 1, 0.5, 1]]}, "held_out": {"rows": []}}
    scores = [{"name": view.name, "psnr": 20.0, "ssim": 0.5} for view in own]
    images = FieldImages(own[:2], own, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), False, [])
    html = render_page(
        FieldPage(summary, scores, images, np.zeros(3, np.float32), tables, tmp_path, None, ())
    )
    shown = re.findall(r"data:image/(jpeg|png);base64,([A-Za-z0-9+/=]+)", html)
    assert len(shown) == 24 and len(html.encode()) < 5e6  # 41e6 as PNGs of 800 pixels
    for n in range(8):
        seen = Image.open(BytesIO(base64.b64decode(shown[3 * n][1])))
        means = [
            np.asarray(each.reduce(k), float) for each, k in ((seen, 8), (Image.fromarray(own[n].image), 10))
        ]
        assert seen.size == (640, 480) and np.abs(means[0] - means[1]).mean() < 2
