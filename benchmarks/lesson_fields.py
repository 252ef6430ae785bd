"""Record the lesson's page on fields: a rendered scene as Gaussians and as a neural field. `python -m benchmarks.lesson_fields`."""

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
from epipole.fields.nerf.hash_field import DELTA, FEATURES, HashField, colored, render_hash, sampled
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
from epipole.synthetic import render as render_scene
from epipole.synthetic.scene import Box, Sphere, SyntheticScene

RECORD = REPOSITORY / "src" / "epipole" / "lesson" / "assets" / "fields.json"
SIDE = 200
"""Width and height of an image in pixels."""
SUPERSAMPLING = 3
"""Images are rendered larger by this factor, then reduced to avoid aliasing."""
NUM_VIEWS = 72
FOCAL = 1.3
"""Focal length in image widths."""
SCENE_CENTER = np.array([0.0, 0.0, 0.3])
PIXELS = ((104, 92), (61, 118), (140, 76), (100, 150), (22, 30))
"""(column, row) of the pixels that the page examines."""
SHOWN_VIEW = 3
"""Index of the held-out view that the page shows."""


def still_life() -> SyntheticScene:
    """Boxes and spheres on a table."""
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
    """Write views from all around and above, with a transparent background, and transforms.json."""
    side = SIDE * SUPERSAMPLING
    camera = Camera("SIMPLE_PINHOLE", side, side, [FOCAL * side, 0.5 * (side - 1), 0.5 * (side - 1)])
    frames: list[dict[str, Any]] = []
    for k in range(NUM_VIEWS):
        azimuth = 2.399963 * k  # golden angle
        elevation = np.deg2rad(10.0 + 65.0 * (k + 0.5) / NUM_VIEWS)
        level = np.cos(elevation)
        direction = np.array([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)])
        cam_from_world = look_at(SCENE_CENTER + 4.0 * direction, SCENE_CENTER)
        rendered = render_scene(still_life(), camera, cam_from_world)
        alpha = np.isfinite(rendered.depth)[..., None]
        premultiplied = np.dstack([rendered.rgb * alpha, 255.0 * alpha]).astype(np.float32)
        reduced = cv2.resize(premultiplied, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        reduced[..., :3] *= 255.0 / np.maximum(reduced[..., 3:], 1.0)
        rgba = np.rint(reduced).clip(0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{k:03d}.png"), cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))
        matrix = cam_from_world.inverse().as_matrix() @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"./{k:03d}.png", "transform_matrix": matrix.tolist()})
    angle = 2.0 * np.arctan(0.5 / FOCAL)
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))


def marched(
    field: HashField, camera: Camera, cam_from_world: Rigid3, pixel: tuple[int, int]
) -> dict[str, Any]:
    """All samples along a ray, ignoring occlusion: distance, optical thickness (sigma delta) and color."""
    rays, offset = rays_of_camera(camera, cam_from_world), np.full(1, -0.5, np.float32)
    number = np.array([pixel[1] * camera.width + pixel[0]])
    found = sampled(field, rays, number, np.zeros(1, np.int64), offset, 4096, 4096)
    thickness = np.exp(np.minimum(found.said[:, 0] + kernels.SHIFT, kernels.LARGEST_RAW)) * DELTA
    joined = np.hstack([found.said, np.repeat(found.basis, len(found.said), axis=0)])
    color = 1.0 / (1.0 + np.exp(-colored(field, joined)[-1]))
    return {
        "distance": rounded(found.positions[:, 3] * field.room.size),
        "thickness": rounded(thickness),
        "color": rounded(color),
    }


def splatted(rendered: Rendering, camera: Camera, pixel: tuple[int, int]) -> dict[str, Any]:
    """The Gaussians of a pixel's tile at that pixel, nearest first; distances are along its ray."""
    column, row = pixel
    distance_over_depth = float(np.linalg.norm(np.linalg.solve(camera.K, [column, row, 1.0])))
    tiles = rendered.record
    tile = row // TILE * tiles.num_across + column // TILE
    e = tiles.ellipses[tiles.pairs_of_tile[tiles.start[tile] : tiles.start[tile + 1], 0]]
    e = e[:, : DEPTH + 1].astype(np.float64)
    x, y = column - e[:, X], row - e[:, Y]
    power = 8.0 * (e[:, XX] * x * x + e[:, XY] * x * y + e[:, YY] * y * y)
    opacity = np.exp(8.0 * e[:, PEAK])
    near = opacity * np.exp(power) > 0.2 * LEAST_ALPHA  # all others contribute nothing
    return {
        "in_tile": len(e),
        "distance": rounded(distance_over_depth * e[near, DEPTH]),
        "opacity": rounded(opacity[near]),
        "power": rounded(power[near]),
        "color": rounded(e[near, RED : BLUE + 1]),
    }


def rounded(values: np.ndarray) -> Any:
    """Nested lists of the values, rounded to six digits."""
    return json.loads(
        json.dumps(np.asarray(values, np.float64).tolist()), parse_float=lambda v: float(f"{float(v):.6g}")
    )


def operations_of_query(field: HashField) -> int:
    """Multiplications and additions of one query: eight corners per level, and one pass through the layers."""
    return 2 * (8 * len(field.cells) * FEATURES + sum(weight.size for weight in field.weights))


def encoded(rgb: np.ndarray) -> str:
    """An image as base64 of WebP, as the page shows it."""
    shown = np.rint(255 * np.clip(rgb, 0, 1)).astype(np.uint8)
    _, data = cv2.imencode(".webp", cv2.cvtColor(shown, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_WEBP_QUALITY, 80])
    return base64.b64encode(data.tobytes()).decode("ascii")


def examined(field: HashField, cloud: GaussianCloud, folder: Path) -> dict[str, Any]:
    """Renders of one held-out view by both fields, and the samples behind some of its pixels."""
    view = gather_field_images(folder, FieldOptions()).test[SHOWN_VIEW]
    white = np.ones(3, np.float32)
    rendered = render(cloud, view.camera, view.cam_from_world)
    splat, (nerf, _, _) = rendered.over(white), render_hash(field, view.camera, view.cam_from_world, white)
    pixels = [
        {
            "at": [column, row],
            "drawn": {"splat": rounded(splat[row, column]), "nerf": rounded(nerf[row, column])},
            "nerf": marched(field, view.camera, view.cam_from_world, (column, row)),
            "splat": splatted(rendered, view.camera, (column, row)),
        }
        for column, row in PIXELS
    ]
    distances = [d for pixel in pixels for kind in ("nerf", "splat") for d in pixel[kind]["distance"]]
    return {
        "truth": encoded(view.over(white)),
        "pictures": {"splat": encoded(splat), "nerf": encoded(nerf)},
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
    """Render the scene, train both fields, and write the record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--time", default="60s", help="training time of each field")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="epipole-fields-") as out:
        scene, compared = Path(out) / "scene", Path(out) / "out"
        scene.mkdir()
        write_views(scene)
        found = compare_fields(scene, compared, time=arguments.time, background="white")
        field = read_neural(compared / "nerf" / "hash.npz")
        cloud = read_gaussians(compared / "splat" / "splat.ply")
        record = {"time": arguments.time, "rows": found.rows, **examined(field, cloud, scene)}
    RECORD.write_text(json.dumps(record, separators=(",", ":"), allow_nan=False) + "\n")
    Console().print(record["rows"])


if __name__ == "__main__":
    main()
