"""The page of a calibration: verdict, cameras with their standard deviations, where it is known and where not, every view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from epipole.calibration.calibrate import Calibration, ViewState
from epipole.calibration.comparison import CrossCheck
from epipole.calibration.coverage import coverage
from epipole.calibration.uncertainty import projection_sigma
from epipole.calibration.verdict import Verdict
from epipole.image import color_map
from epipole.report.charts import draw_curves, draw_histogram, histogram_of, nice_ticks, svg, tick_text
from epipole.report.markup import escape, number, plural
from epipole.report.plain_page import figure, notes_list, picture_uri, plain_page, section

_GRID = (48, 36)
_RANGES = np.geomspace(2.0, 2000.0, 25)  # of a board's square
_RESIDUALS_SHOWN = 4000
_NAMES = ("left", "right")


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationPage:
    """What the page shows."""

    calibration: Calibration
    check: CrossCheck | None
    verdict: Verdict
    names: tuple[tuple[str, ...], ...]
    """[camera][view]"""
    problems: dict[str, str]
    version: str


def render_calibration_page(page: CalibrationPage) -> str:
    """One HTML page with everything inside it."""
    found = page.calibration
    verdict = "notes" if page.verdict.passes else "notes failed"
    mark = "" if page.verdict.passes else ' class="warn"'
    body = [
        f"<h1>Calibration of {plural(len(found.cameras), 'camera')}</h1>",
        f'<ul class="{verdict}"><li{mark}>{escape(page.verdict.sentence)}</li></ul>',
        notes_list(list(page.problems.values())),
        section("Checks", _checks(page)),
    ]
    for c in range(len(found.cameras)):
        who = f"{_NAMES[c].capitalize()} camera" if len(found.cameras) == 2 else "Camera"
        body.append(section(who, _camera(page, c)))
    if len(found.cameras) == 2:
        body.append(section("How the cameras stand", _rig(found)))
    body.append(section("Views", _views(page)))
    return plain_page("Calibration", "".join(body), page.version)


def _checks(page: CalibrationPage) -> str:
    found, check = page.calibration, page.check
    used = found.residuals_px[found.used_mask]
    rows = [
        ("corners used", f"{int(found.used_mask.sum())} of {len(found.used_mask)}"),
        ("root mean square distance of a corner", f"{found.rms_px:.3f} px"),
        ("noise of a corner's coordinate", f"{found.uncertainty.noise_px:.3f} px"),
    ]
    if check is not None:
        rows += [
            ("half of the views fitted: their distance", f"{check.fitted_rms_px:.3f} px"),
            ("the other half, held out", f"{check.held_out_rms_px:.3f} px"),
        ]
        rows += [
            (f"difference of both halves' projections{_of(found, c)}", f"{d:.3f} px (median)")
            for c, d in enumerate(check.difference_px)
        ]
        rows.append(
            (
                "mean square of both halves' differences in all unknowns, in standard deviations",
                f"{check.disagreement:.2f}"
                + (f"; all are widened {check.widening:.2f} times" if check.widening > 1 else ""),
            )
        )
    if found.config.refine_warp:
        rows.append(("middle of the board above its edges", ", ".join(f"{w:.3g}" for w in found.state.warp)))
    cells = "".join(f"<tr><td>{a}</td><td>{b}</td></tr>" for a, b in rows)
    chart = draw_histogram(histogram_of(np.linalg.norm(used, axis=1), "distance of a corner, px"))
    return f'<div class="two"><div class="scroll"><table>{cells}</table></div><div>{chart}</div></div>'


def _of(found: Calibration, camera: int) -> str:
    return f", {_NAMES[camera]}" if len(found.cameras) == 2 else ""


def _camera(page: CalibrationPage, c: int) -> str:
    found = page.calibration
    camera, sigma = found.cameras[c], found.params_sigma(c)
    rows = "".join(
        f'<tr><td>{name}</td><td class="num">{value:.6g}</td><td class="num">{deviation:.2g}</td></tr>'
        for name, value, deviation in zip(camera.model.param_names, camera.params, sigma)
    )
    table = (
        f'<p class="soft">{camera.model.name}, {camera.width} x {camera.height}. Corners cover '
        f"{100 * coverage(found, c):.0f} % of the picture.</p>"
        f'<table><tr><th></th><th class="num">value</th><th class="num">standard deviation</th></tr>{rows}</table>'
    )
    columns, rows_ = _GRID
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, columns), np.linspace(0, camera.height - 1, rows_))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    far = projection_sigma(found.state, found.uncertainty, c, pixels, np.inf).reshape(rows_, columns)
    shown = np.repeat(np.repeat(np.log10(np.maximum(far, 1e-6)), 12, axis=0), 12, axis=1)
    low, high = np.nanpercentile(far, (1, 99))
    heat = figure(
        f"how well a far point's projection is known: {low:.3f} px (blue) to {high:.3f} px (red), logarithmic",
        picture_uri(color_map(shown)),
    )
    return (
        f'<div class="two"><div>{table}</div><div>{_coverage_map(found, c)}</div></div>'
        f'<div class="two"><div>{heat}</div><div>{_against_range(found, c)}</div></div>'
    )


def _coverage_map(found: Calibration, c: int) -> str:
    """Every corner where it was seen: used, or left out; with a line ten times its residual."""
    camera, corners = found.cameras[c], found.corners
    own = np.flatnonzero(corners.camera == c)
    own = own[:: max(1, len(own) // _RESIDUALS_SHOWN)]
    size = max(camera.width, camera.height) / 380
    parts = [f'<rect x="0" y="0" width="{camera.width}" height="{camera.height}" class="axis"/>']
    for k in own:
        x, y = corners.pixels[k]
        used = found.used_mask[k]
        color = "var(--accent)" if used else "var(--warn)"
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{1.6 * size:.2f}" style="fill:{color}"/>')
        dx, dy = found.residuals_px[k] * 20 * size
        if used and np.isfinite(dx):
            parts.append(
                f'<path d="M{x:.1f} {y:.1f}l{dx:.1f} {dy:.1f}" style="stroke:{color};stroke-width:{0.7 * size:.2f}"/>'
            )
    drawing = svg(camera.width, camera.height, parts, "corners in the picture")
    return f'<figure><figcaption class="soft">corners in the picture (orange: left out), residuals drawn larger</figcaption>{drawing}</figure>'


def _against_range(found: Calibration, c: int) -> str:
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
        {"middle": (ranges, curve(middle)), "near a corner": (ranges, curve(corner))},
        "distance from the camera, in the board's unit",
        "projection known to, px",
    )


def _rig(found: Calibration) -> str:
    rig = found.rig()
    x, y, z = rig.right_from_left.inverse().translation
    vector = rig.right_from_left.log()[3:]
    angle = np.rad2deg(np.linalg.norm(vector))
    return (
        f"<p>Baseline {rig.baseline:.6g} with a standard deviation of {found.baseline_sigma():.2g} (in the board's unit); the right camera "
        f"stands at ({x:.4g}, {y:.4g}, {z:.4g}) of the left one, turned by {angle:.3f} degrees.</p>"
    )


def _views(page: CalibrationPage) -> str:
    found = page.calibration
    rows = []
    longest = max(
        [float(np.nanmax(found.view_rms_px(c), initial=0.0)) for c in range(len(found.cameras))] + [1e-9]
    )
    ticks = ", ".join(tick_text(t) for t in nice_ticks(0.0, longest, 3)[-1:])
    for c, names in enumerate(page.names):
        rms = found.view_rms_px(c)
        for v, name in enumerate(names):
            state = found.view_states[c][v]
            corners = found.corners.of_view(c, v)
            used = int(found.used_mask[corners].sum())
            kind = "" if state is ViewState.USED else ' class="absent"'
            width = 0.0 if not np.isfinite(rms[v]) else 120.0 * min(float(rms[v]) / longest, 1.0)
            bar = f'<svg viewBox="0 0 120 10" style="width:120px"><rect class="bar" width="{width:.1f}" height="10"/></svg>'
            rows.append(
                f'<tr{kind}><td class="name">{escape(name)}</td><td class="num">{used} of {len(corners)}</td>'
                f'<td class="num">{number(float(rms[v]), 3)}</td><td>{bar}</td><td class="state">{escape(state.value)}</td></tr>'
            )
    return (
        f'<div class="scroll"><table><tr><th>picture</th><th>corners used</th><th>rms, px</th><th>0 to {ticks} px</th>'
        f"<th></th></tr>{''.join(rows)}</table></div>"
    )
