"""The page that shows Gaussians by itself, in any browser."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from epipole.pipelines.fields.cameras import Shot
from epipole.report.frame import render
from epipole.report.gaussians import DEGREE_KEPT, PackedGaussians, most_visible, packed
from epipole.report.markup import count, plural
from epipole.report.scene_page import ScenePage
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.viewer import SplatView

MOST_CAMERAS = 1000
"""That the page steps through, spread over all."""


def page_of(view: SplatView, name: str, cameras: Sequence[Shot], background: float, most: int) -> ScenePage:
    """One HTML page with everything inside it.

    Args:
        view: the Gaussians, and from where they are seen first.
        name: of the file or folder.
        cameras: of the training, none or more.
        background: its grey value, 0 to 1.
        most: at most so many Gaussians are in it, the most visible.
    """
    cloud = view.cloud.rows(most_visible(view.cloud, most))
    found = packed(cloud)
    shown = shown_in_words(len(cloud), len(view.cloud))
    html = render(
        __package__,
        "share.html.jinja",
        title=name,
        shown=shown,
        colours=_colours_in_words(view.cloud),
        packed=found,
        scene=_scene(view, found, len(cloud), background) | {"cameras": _cameras(cameras)},
    )
    return ScenePage(html, shown)


def shown_in_words(shown: int, whole: int) -> str:
    """How many of how many."""
    return (
        plural(shown, "Gaussian")
        if shown == whole
        else f"The most visible {count(shown)} of {count(whole)} Gaussians"
    )


def _colours_in_words(cloud: GaussianCloud) -> str:
    degree = cloud.sh_degree
    if degree == 0:
        return "Colours are the same from all sides"
    if degree <= DEGREE_KEPT:
        return "Colours change with the direction, as trained"
    return f"Colours change with the direction by harmonics of degree {DEGREE_KEPT}, of {degree} that were trained"


def _scene(view: SplatView, found: PackedGaussians, num_shown: int, background: float) -> dict[str, Any]:
    return {
        "count": num_shown,
        "scaleRange": found.scale_range,
        "colourRange": found.colour_range,
        "harmonicRange": found.harmonic_range,
        "position": view.position.tolist(),
        "lookAt": view.look_at.tolist(),
        "up": view.up.tolist(),
        "background": background,
    }


def _cameras(shots: Sequence[Shot]) -> list[dict[str, Any]]:
    """Place, axes and view of cameras; their middle is taken to be that of the picture."""
    rows = np.linspace(0, len(shots) - 1, min(len(shots), MOST_CAMERAS)).astype(np.int64).tolist()
    out = []
    for shot in (shots[row] for row in rows):
        rotation = shot.cam_from_world.rotation
        out.append(
            {
                "name": shot.name,
                "position": _rounded(shot.cam_from_world.centers()),
                "right": _rounded(rotation[0]),
                "ahead": _rounded(rotation[2]),
                "focal": round(float(shot.camera.K[0, 0]), 3),
                "size": [shot.camera.width, shot.camera.height],
            }
        )
    return out


def _rounded(values: np.ndarray) -> list[float]:
    return [float(f"{v:.7g}") for v in values]
