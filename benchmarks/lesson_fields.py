"""Record the lesson's page on fields: one scene learnt as Gaussians and as a neural field, and some pixels of both. `python -m benchmarks.lesson_fields`.

The scene is drawn, so that no image of anybody else's is in the package.
"""

from __future__ import annotations

import argparse
import base64
import json
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console

from benchmarks.measure import REPOSITORY
from benchmarks.rasterizer import FLOPS
from epipole.cameras import Camera
from epipole.fields.nerf import _hash_kernels as kernels
from epipole.fields.nerf.hash_field import DELTA, FEATURES, HashField, coloured, render_hash, sampled
from epipole.fields.rays import rays_of_camera
from epipole.fields.splat._blend_kernels import OVER
from epipole.fields.splat._projection_kernels import BLUE, DEPTH, PEAK, RED, XX, XY, YY, X, Y
from epipole.fields.splat._simd_kernels import LARGEST_ALPHA, LEAST_ALPHA
from epipole.fields.splat._tile_kernels import TILE
from epipole.fields.splat.rasterizer import Rendering, render
from epipole.geometry import Rigid3
from epipole.io.gaussians.files import read_gaussians
from epipole.pipelines.fields.comparison import compare_fields
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.images import gather_field_images
from epipole.pipelines.fields.kinds import read_neural
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.synthetic import look_at
from epipole.synthetic import render as draw_scene
from epipole.synthetic.scene import Box, Sphere, SyntheticScene

RECORD = REPOSITORY / "src" / "epipole" / "lesson" / "assets" / "fields.json"
SIDE, FINER, VIEWS, FOCAL = 200, 3, 72, 1.3
"""Pixels of an image across, drawn so many times finer; images; and the focal length over the image's width."""
MIDDLE = np.array([0.0, 0.0, 0.3])
PIXELS = ((104, 92), (61, 118), (140, 76), (100, 150), (22, 30))
"""Columns and rows that are looked into."""
SHOWN = 3
"""The held-out view that is looked at."""


def still_life() -> SyntheticScene:
    """Boxes and balls on a table."""
    return SyntheticScene.of(
        [
            Box(center=(0.0, 0.0, -0.1), half_size=(1.2, 1.2, 0.1), color=(0.62, 0.5, 0.36), seed=3),
            Box(
                center=(-0.35, 0.3, 0.45),
                half_size=(0.3, 0.25, 0.45),
                angle_rad=0.5,
                color=(0.25, 0.42, 0.6),
                seed=5,
            ),
            Box(
                center=(0.5, -0.35, 0.2),
                half_size=(0.3, 0.3, 0.2),
                angle_rad=-0.3,
                color=(0.68, 0.3, 0.22),
                seed=7,
            ),
            Sphere(center=(0.5, -0.35, 0.68), radius=0.28, color=(0.8, 0.7, 0.3), seed=9),
            Sphere(center=(-0.45, -0.5, 0.26), radius=0.26, color=(0.3, 0.55, 0.35), seed=11),
        ]
    )


def write_views(folder: Path) -> None:
    """All around and above, as transforms.json with transparent surroundings."""
    side = SIDE * FINER
    camera = Camera("SIMPLE_PINHOLE", side, side, [FOCAL * side, 0.5 * (side - 1), 0.5 * (side - 1)])
    frames: list[dict[str, Any]] = []
    for k in range(VIEWS):
        around, up = 2.399963 * k, np.deg2rad(10.0 + 65.0 * (k + 0.5) / VIEWS)  # the golden angle
        out = np.array([np.cos(around) * np.cos(up), np.sin(around) * np.cos(up), np.sin(up)])
        seen = look_at(MIDDLE + 4.0 * out, MIDDLE)
        rendered = draw_scene(still_life(), camera, seen)
        alpha = np.isfinite(rendered.depth)[..., None]
        premultiplied = np.dstack([rendered.rgb * alpha, 255.0 * alpha]).astype(np.float32)
        small = cv2.resize(premultiplied, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        small[..., :3] *= 255.0 / np.maximum(small[..., 3:], 1.0)
        rgba = np.rint(small).clip(0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{k:03d}.png"), cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))
        matrix = seen.inverse().as_matrix() @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"./{k:03d}.png", "transform_matrix": matrix.tolist()})
    angle = 2.0 * np.arctan(0.5 / FOCAL)
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))


def marched(field: HashField, camera: Camera, position: Rigid3, pixel: tuple[int, int]) -> dict[str, Any]:
    """All samples along a ray, as if nothing hid another: distance, thickness (sigma delta) and colour."""
    rays, at = rays_of_camera(camera, position), np.full(1, -0.5, np.float32)
    number = np.array([pixel[1] * camera.width + pixel[0]])
    found = sampled(field, rays, number, np.zeros(1, np.int64), at, 4096, 4096)
    thickness = np.exp(np.minimum(found.said[:, 0] + kernels.SHIFT, kernels.LARGEST_RAW)) * DELTA
    joined = np.hstack([found.said, np.repeat(found.basis, len(found.said), axis=0)])
    colour = 1.0 / (1.0 + np.exp(-coloured(field, joined)[-1]))
    return {
        "distance": given(found.positions[:, 3] * field.room.size),
        "thickness": given(thickness),
        "colour": given(colour),
    }


def splatted(rendered: Rendering, camera: Camera, pixel: tuple[int, int]) -> dict[str, Any]:
    """The Gaussians of a pixel's tile, the nearest first, as this pixel sees them; distances are along its ray."""
    column, row = pixel
    longer = float(np.linalg.norm(np.linalg.solve(camera.K, [column, row, 1.0])))
    tiles = rendered.record
    tile = row // TILE * tiles.num_across + column // TILE
    e = tiles.ellipses[tiles.pairs_of_tile[tiles.start[tile] : tiles.start[tile + 1], 0]]
    e = e[:, : DEPTH + 1].astype(np.float64)
    x, y = column - e[:, X], row - e[:, Y]
    power = 8.0 * (e[:, XX] * x * x + e[:, XY] * x * y + e[:, YY] * y * y)
    opacity = np.exp(8.0 * e[:, PEAK])
    near = opacity * np.exp(power) > 0.2 * LEAST_ALPHA  # the others are far outside
    return {
        "in_tile": len(e),
        "distance": given(longer * e[near, DEPTH]),
        "opacity": given(opacity[near]),
        "power": given(power[near]),
        "colour": given(e[near, RED : BLUE + 1]),
    }


def given(values: np.ndarray) -> Any:
    """Six digits."""
    return json.loads(
        json.dumps(np.asarray(values, np.float64).tolist()), parse_float=lambda v: float(f"{float(v):.6g}")
    )


def operations_of_query(field: HashField) -> int:
    """Products and sums of one: eight corners at each level are weighed, and every weight of the layers is met once."""
    return 2 * (8 * len(field.cells) * FEATURES + sum(weight.size for weight in field.weights))


def image(rgb: np.ndarray) -> str:
    """As the page shows it."""
    shown = np.rint(255 * np.clip(rgb, 0, 1)).astype(np.uint8)
    _, encoded = cv2.imencode(".webp", cv2.cvtColor(shown, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_WEBP_QUALITY, 80])
    return base64.b64encode(encoded.tobytes()).decode("ascii")


def looked_into(field: HashField, cloud: GaussianCloud, folder: Path) -> dict[str, Any]:
    """Images of one view, and the pixels."""
    view = gather_field_images(folder, FieldOptions()).test[SHOWN]
    white = np.ones(3, np.float32)
    rendered = render(cloud, view.camera, view.cam_from_world)
    splat, (nerf, _, _) = rendered.over(white), render_hash(field, view.camera, view.cam_from_world, white)
    pixels = [
        {
            "at": list(at),
            "drawn": {"splat": given(splat[at[1], at[0]]), "nerf": given(nerf[at[1], at[0]])},
            "nerf": marched(field, view.camera, view.cam_from_world, at),
            "splat": splatted(rendered, view.camera, at),
        }
        for at in PIXELS
    ]
    distances = [
        d for pixel in pixels for trajectory in ("nerf", "splat") for d in pixel[trajectory]["distance"]
    ]
    return {
        "truth": image(view.over(white)),
        "pictures": {"splat": image(splat), "nerf": image(nerf)},
        "near": np.floor(10.0 * min(distances)) / 10.0 - 0.1,
        "far": np.ceil(10.0 * max(distances)) / 10.0 + 0.1,
        "operations": {"query": operations_of_query(field), "pair": FLOPS[0]},
        "over_nerf": float(kernels.OVER),
        "over": float(OVER),
        "least_alpha": float(LEAST_ALPHA),
        "largest_alpha": float(LARGEST_ALPHA),
        "side": SIDE,
        "pixels": pixels,
    }


def main() -> None:
    """Draw, train both, look into pixels, and write the record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--time", default="60s", help="for each of the two")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="epipole-fields-") as out:
        scene, compared = Path(out) / "scene", Path(out) / "out"
        scene.mkdir()
        write_views(scene)
        found = compare_fields(scene, compared, time=arguments.time, background="white")
        field = read_neural(compared / "nerf" / "hash.npz")
        cloud = read_gaussians(compared / "splat" / "splat.ply")
        record = {"time": arguments.time, "rows": found.rows, **looked_into(field, cloud, scene)}
    RECORD.write_text(json.dumps(record, separators=(",", ":"), allow_nan=False) + "\n")
    Console().print(record["rows"])


if __name__ == "__main__":
    main()
