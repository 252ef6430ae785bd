"""A model of photographs in meters: measured places and lengths, by the job."""

import json

import numpy as np
from photographs import CAMERA, neighboring_views

from epipole import reconstruct
from epipole.geometry import align_points
from epipole.io import read_colmap_model


def test_the_job_states_what_fixed_the_scale(rendered, reconstructed, out_of_six, tmp_path, rng):
    views = neighboring_views(6)
    names = [f"view_{n:02d}.jpg" for n in range(6)]
    positions = views.centers() + 0.01 * rng.normal(size=(6, 3))
    (tmp_path / "places.txt").write_text(
        "".join(f"{n} {x} {y} {z}\n" for n, (x, y, z) in zip(names, positions, strict=True))
    )
    ends, lines = np.array([[-0.6, 2.4, 1.0], [0.5, 2.4, 1.2]]), []
    for end, position in zip("ab", ends, strict=True):
        for n in (0, 3, 5):
            x, y = CAMERA.project(views[n].apply(position[None]))[0]
            lines.append(f"wall {np.linalg.norm(ends[0] - ends[1])} {end} {names[n]} {x} {y}\n")
    (tmp_path / "lengths.txt").write_text("".join(lines))
    assert reconstructed.summary["scale"] == "up to scale: images alone do not determine lengths"
    assert not reconstructed.summary["is_metric"] and reconstructed.summary["anchor"] is None
    options = {
        "positions": tmp_path / "places.txt",
        "positions_sigma_m": 0.01,
        "lengths": tmp_path / "lengths.txt",
    }
    reconstruct(rendered, out_of_six, **options)
    summary = json.loads((out_of_six / "summary.json").read_text())
    assert (
        summary["is_metric"]
        and "measured positions" in summary["scale"]
        and "length wall" in summary["scale"]
    )
    model = read_colmap_model(out_of_six / "sparse" / "0")
    true = views.centers()[[names.index(n) for n in model.images.name]]
    there = model.camera_centers_in_world()
    assert np.abs(there - true).max() < 0.1  # in the world of the places
    scale = float(align_points(there, true).scale)
    assert abs(scale - 1.0) < max(3 * summary["anchor"]["relative_sigma"], 0.01)
    assert summary["scale"] in (out_of_six / "report.html").read_text(encoding="utf-8")
    only = reconstruct(rendered, out_of_six, lengths=tmp_path / "lengths.txt").summary
    assert only["scale"].startswith("meters, from length wall: known to ")
    (tmp_path / "lengths.txt").write_text("".join(line for line in lines if names[0] in line))
    none = reconstruct(rendered, out_of_six, lengths=tmp_path / "lengths.txt")
    assert not none.summary["is_metric"]
    assert any("stays up to scale: wall: seen in 1 posed image" in w for w in none.warnings)
