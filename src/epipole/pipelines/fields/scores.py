"""Scores of a render against a held-out image."""

from __future__ import annotations

import numpy as np

from epipole.fields.exposure import color_match
from epipole.fields.photometric import photometric_loss, psnr
from epipole.fields.training_view import TrainingView


def scores_of(rendered: np.ndarray, view: TrainingView, background: np.ndarray) -> dict[str, float]:
    """PSNR in dB, SSIM, and PSNR after the best color transform (`psnr_matched`), over the used pixels.

    Args:
        rendered: (h, w, 3) render.
        view: held-out view.
        background: (3,) background color.
    """
    truth = view.over(background)
    used = np.ones(truth.shape[:2], bool) if view.used_mask is None else view.used_mask
    if not used.any():
        return dict.fromkeys(("psnr", "ssim", "psnr_matched"), float("nan"))
    shown, wanted = rendered[used][None], truth[used][None]
    colors = color_match(shown, wanted).astype(np.float32)
    matched = shown @ colors[:, :3].T + colors[:, 3]
    weight = used[..., None].astype(np.float32)
    ssim = photometric_loss(rendered * weight, truth * weight).ssim
    return {"psnr": psnr(shown, wanted), "ssim": ssim, "psnr_matched": psnr(matched, wanted)}
