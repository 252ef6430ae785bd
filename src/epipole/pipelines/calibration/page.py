"""The page of a calibration: verdict, cameras and their standard deviations, uncertainty, views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from markupsafe import Markup

from epipole.image import color_map
from epipole.pipelines.calibration.calibrate import Calibration, ViewState
from epipole.pipelines.calibration.coverage import coverage
from epipole.pipelines.calibration.files import CalibrationRun
from epipole.pipelines.calibration.uncertainty import projection_sigma
from epipole.report.charts import draw_curves, draw_histogram, histogram_of, nice_ticks, tick_text
from epipole.report.frame import render
from epipole.report.images import png_uri
from epipole.report.markup import number

_GRID = (48, 36)
_RANGES = np.geomspace(2.0, 2000.0, 25)  # of a board's square
_RESIDUALS_SHOWN = 4000
_NAMES = ("left", "right")
_BAR_LENGTH = 120.0


@dataclass(frozen=True, slots=True)
class _Dot:
    """A corner in the image, with its residual as a line."""

    x: str
    y: str
    is_used: bool
    residual: str
    """Relative line command of an SVG path; empty for none."""


@dataclass(frozen=True, slots=True)
class _ViewLine:
    name: str
    is_used: bool
    corners: str
    rms_px: str
    bar: str
    state: str


def render_page(run: CalibrationRun) -> str:
    """A self-contained HTML page."""
    found = run.calibration
    used = found.residuals_px[found.used_mask]
    longest = _longest_rms_px(found)
    return render(
        __package__,
        "calibration.html.jinja",
        title="Calibration",
        num_cameras=len(found.cameras),
        verdict=run.verdict,
        problems=list(run.problems.values()),
        checks=_checks(run),
        residuals=draw_histogram(histogram_of(np.linalg.norm(used, axis=1), "reprojection error, px")),
        cameras=[_camera(run, c) for c in range(len(found.cameras))],
        rig=_rig(found) if len(found.cameras) == 2 else None,
        views=_views(run, longest),
        longest_px=", ".join(tick_text(t) for t in nice_ticks(0.0, longest, 3)[-1:]),
    )


def _checks(run: CalibrationRun) -> list[tuple[str, str]]:
    found, check = run.calibration, run.check
    rows = [
        ("corners used", f"{int(found.used_mask.sum())} of {len(found.used_mask)}"),
        ("RMS reprojection error", f"{found.rms_px:.3f} px"),
        ("corner noise per coordinate", f"{found.uncertainty.noise_px:.3f} px"),
    ]
    if check is not None:
        rows += [
            ("RMS reprojection error when half of the views are fitted", f"{check.fitted_rms_px:.3f} px"),
            ("RMS reprojection error of the other half, held out", f"{check.held_out_rms_px:.3f} px"),
        ]
        rows += [
            (f"projection difference between the halves{_of(found, c)}", f"{d:.3f} px (median)")
            for c, d in enumerate(check.difference_px)
        ]
        rows.append(
            (
                "mean squared difference between the halves over all unknowns, in standard deviations",
                f"{check.disagreement:.2f}"
                + (
                    f"; standard deviations are widened by {check.widening:.2f}" if check.widening > 1 else ""
                ),
            )
        )
    if found.config.refine_warp:
        rows.append(
            ("height of the board's center above its edges", ", ".join(f"{w:.3g}" for w in found.state.warp))
        )
    return rows


def _of(found: Calibration, camera: int) -> str:
    return f", {_NAMES[camera]}" if len(found.cameras) == 2 else ""


def _camera(run: CalibrationRun, c: int) -> dict[str, object]:
    found = run.calibration
    camera, sigma = found.cameras[c], found.params_sigma(c)
    low, high, heat = _far_sigma(found, c)
    return {
        "title": f"{_NAMES[c].capitalize()} camera" if len(found.cameras) == 2 else "Camera",
        "model": camera.model.name,
        "width": camera.width,
        "height": camera.height,
        "coverage": f"{100 * coverage(found, c):.0f}",
        "params": [
            (name, f"{value:.6g}", f"{deviation:.2g}")
            for name, value, deviation in zip(camera.model.param_names, camera.params, sigma)
        ],
        "unit": max(camera.width, camera.height) / 380,
        "dots": _dots(found, c),
        "far_sigma": (f"{low:.3f}", f"{high:.3f}", heat),
        "sigma_against_range": _against_range(found, c),
    }


def _far_sigma(found: Calibration, c: int) -> tuple[float, float, str]:
    """Projection uncertainty of distant points over the image: 1st and 99th percentile, and a color map."""
    camera, (columns, rows) = found.cameras[c], _GRID
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, columns), np.linspace(0, camera.height - 1, rows))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    far = projection_sigma(found.state, found.uncertainty, c, pixels, np.inf).reshape(rows, columns)
    shown = np.repeat(np.repeat(np.log10(np.maximum(far, 1e-6)), 12, axis=0), 12, axis=1)
    low, high = np.nanpercentile(far, (1, 99))
    return float(low), float(high), png_uri(color_map(shown))


def _dots(found: Calibration, c: int) -> list[_Dot]:
    """Used and rejected corners, with magnified residuals."""
    camera, corners = found.cameras[c], found.corners
    own = np.flatnonzero(corners.camera == c)
    own = own[:: max(1, len(own) // _RESIDUALS_SHOWN)]
    size = max(camera.width, camera.height) / 380
    dots = []
    for k in own:
        (x, y), (dx, dy) = corners.pixels[k], found.residuals_px[k] * 20 * size
        used = bool(found.used_mask[k])
        dots.append(
            _Dot(f"{x:.1f}", f"{y:.1f}", used, f"l{dx:.1f} {dy:.1f}" if used and np.isfinite(dx) else "")
        )
    return dots


def _against_range(found: Calibration, c: int) -> Markup:
    camera, unit = found.cameras[c], found.config.board.square
    middle = np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]])
    corner = np.array([[0.1 * camera.width, 0.1 * camera.height]])

    def curve(at: Float64[np.ndarray, "1 2"]) -> list[float]:
        return [
            float(projection_sigma(found.state, found.uncertainty, c, at, float(r * unit))[0])
            for r in _RANGES
        ]

    ranges = (_RANGES * unit).tolist()
    return draw_curves(
        {"image center": (ranges, curve(middle)), "near a corner": (ranges, curve(corner))},
        "distance from the camera, in the board's unit",
        "projection uncertainty, px",
    )


def _rig(found: Calibration) -> dict[str, str]:
    rig = found.rig()
    x, y, z = rig.right_from_left.inverse().translation
    angle = np.rad2deg(np.linalg.norm(rig.right_from_left.log()[3:]))
    return {
        "baseline": f"{rig.baseline:.6g}",
        "baseline_sigma": f"{found.baseline_sigma():.2g}",
        "position": f"({x:.4g}, {y:.4g}, {z:.4g})",
        "angle_deg": f"{angle:.3f}",
    }


def _longest_rms_px(found: Calibration) -> float:
    longest = [float(np.nanmax(found.view_rms_px(c), initial=0.0)) for c in range(len(found.cameras))]
    return max([*longest, 1e-9])


def _views(run: CalibrationRun, longest_px: float) -> list[_ViewLine]:
    found = run.calibration
    lines = []
    for c, images in enumerate(run.images):
        names = [path.name for path in images]
        rms = found.view_rms_px(c)
        for v, name in enumerate(names):
            state = found.view_states[c][v]
            corners = found.corners.of_view(c, v)
            used = int(found.used_mask[corners].sum())
            length = _BAR_LENGTH * min(float(rms[v]) / longest_px, 1.0) if np.isfinite(rms[v]) else 0.0
            lines.append(
                _ViewLine(
                    name,
                    state is ViewState.USED,
                    f"{used} of {len(corners)}",
                    number(float(rms[v]), 3),
                    f"{length:.1f}",
                    state.value,
                )
            )
    return lines
