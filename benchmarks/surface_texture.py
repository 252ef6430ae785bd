"""Textured meshes and splats on the same held-out views, for `benchmarks.surfaces`."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np

import epipole
from benchmarks.tasks.surfaces import SurfaceScene, prepare_scene, write_part
from epipole.dense.texturing.rendering import render_textured
from epipole.io.images.photographs import read_rgb
from epipole.io.images.rgba import write_png
from epipole.io.meshes.gltf import read_glb
from epipole.scene.textured_mesh import TexturedMesh

HELD_OUT = {"courtyard": (4, 12, 19), "open terrain": (6, 20, 27)}
"""Views that neither the mesh nor the splats are made from."""
SPLAT_SIDE_PX, SPLAT_TIME = 800, "60s"


def texture_part(work: Path, _data: Path) -> dict[str, dict[str, float]]:
    """PSNR of the textured mesh on held-out views, and of splats trained for a minute."""
    rows = {}
    for name, held_out in HELD_OUT.items():
        scene = prepare_scene(name, work)
        kept = [k for k in range(len(scene.names)) if k not in held_out]
        model = write_part(scene.part(kept), work / f"{scene.folder.name}_training")
        out = work / "texture" / scene.folder.name
        shutil.rmtree(out, ignore_errors=True)
        summary = epipole.surface(model, out, threads=2).summary
        mesh = read_glb(out / "textured.glb")
        names = ",".join(scene.names[k] for k in held_out)
        splat = work / "splat" / scene.folder.name
        shutil.rmtree(splat, ignore_errors=True)
        trained = epipole.splat(scene.folder, splat, time=SPLAT_TIME, test=names, max_side_px=SPLAT_SIDE_PX)
        rows[name] = {
            "texture, s": summary["timings_s"]["texture"],
            "all stages, s": summary["seconds"],
            "triangles": float(summary["num_faces"]),
            **_figures(scene, held_out, mesh, splat, out),
            "splat PSNR in metrics.json": float(trained.summary["psnr"]),
        }
    return rows


def _figures(
    scene: SurfaceScene, held_out: tuple[int, ...], mesh: TexturedMesh, splat: Path, out: Path
) -> dict[str, float]:
    """Means over the held-out views, at full size and at that of the splats."""
    size = SPLAT_SIDE_PX, round(SPLAT_SIDE_PX * scene.camera.height / scene.camera.width)
    found: dict[str, list[float]] = {}
    for k in held_out:
        wanted, pose = scene.view(k).rgb, scene.cams_from_world[k]
        rgb, depth = render_textured(mesh, scene.camera, pose)
        write_png(out / f"held_out_{k:03d}.png", rgb)
        is_scene, covered = np.isfinite(scene.depth(k)), np.isfinite(depth)
        small = cv2.resize(wanted, size, interpolation=cv2.INTER_AREA)
        small_rgb, small_depth = render_textured(mesh, scene.camera.scaled_to(*size), pose)
        splatted = read_rgb(splat / "test" / f"{Path(scene.names[k]).stem}.png")
        both = np.isfinite(small_depth)
        row = {
            "coverage of the scene": float((covered & is_scene).sum() / is_scene.sum()),
            "covered sky": float((covered & ~is_scene).mean()),
            "PSNR": psnr(rgb, wanted, covered),
            f"PSNR at {SPLAT_SIDE_PX} px": psnr(small_rgb, small, both),
            "splat PSNR, same pixels": psnr(splatted, small, both),
            "splat PSNR": psnr(splatted, small, np.ones_like(both)),
        }
        for name, value in row.items():
            found.setdefault(name, []).append(value)
    return {name: float(np.mean(values)) for name, values in found.items()}


def psnr(found: np.ndarray, wanted: np.ndarray, mask: np.ndarray) -> float:
    """Peak signal-to-noise ratio over the pixels of a mask."""
    error = found[mask].astype(np.float64) - wanted[mask]
    return float(10.0 * np.log10(255.0**2 / (error**2).mean()))
