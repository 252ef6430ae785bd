"""Clouds and meshes for `benchmarks.surfaces`: scores against the exact surfaces, peak memory, and Open3D on the same depths."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

import epipole
from benchmarks.measure import REPOSITORY, run_measured
from benchmarks.tasks.surface_scenes import PLANS
from benchmarks.tasks.surfaces import SurfaceScene, prepare_scene, write_copies
from epipole.io.meshes.mesh_ply import read_mesh_ply
from epipole.io.meshes.ply import ply_columns
from epipole.pipelines.surfaces.cloud_stage import cloud_units, confirmed_depth
from epipole.pipelines.surfaces.config import SurfaceConfig
from epipole.pipelines.surfaces.depth_stage import depth_in, depth_units
from epipole.pipelines.surfaces.inputs import SurfaceInputs, surface_inputs
from epipole.runs import Job, Unit, open_run

TOLERANCES = (0.005, 0.001)
"""Distances up to which a point is right, relative to the size of the scene."""
SPACING = 0.5
"""Side of the voxels to which points are thinned, relative to the smaller tolerance."""
CENTRAL = (0.05, 0.95)
"""Quantiles of the coordinates between which the size of a scene is measured."""
LARGE, LARGE_VIEWS = (4000, 3000), 6
"""Size of the images of the memory part, and the number of different ones."""


class Truth:
    """Points of the exact surfaces, thinned.

    A result near a point that at least one view sees (`seen`) is right. It should have all points that at least two views see (`shared`).
    """

    def __init__(self, scene: SurfaceScene) -> None:
        """Sample the exact depth of all views, or read the points of an earlier call."""
        rows, file = range(len(scene.names)), scene.folder / "truth.npz"
        sample = np.concatenate([scene.points(k, 16).reshape(-1, 3) for k in rows])
        low, high = np.nanquantile(sample, CENTRAL, axis=0)
        self.size = float(np.linalg.norm(high - low))
        self.side = SPACING * min(TOLERANCES) * self.size
        if not file.is_file():
            seen, shared = [], []
            for k in rows:
                points = scene.points(k, 2)
                known, many = np.isfinite(points).all(axis=2), scene.num_seeing(k, rows, 2) >= 1
                seen.append(thinned(points[known], self.side))
                shared.append(thinned(points[known & many], self.side))
            every, common = (thinned(np.concatenate(part), self.side) for part in (seen, shared))
            np.savez(file, seen=every, shared=common)
        with np.load(file) as stored:
            self.seen, self.shared = stored["seen"], stored["shared"]

    def scores(self, points: np.ndarray) -> dict[str, float]:
        """Precision, recall and F-score at both tolerances, and the median distance to the surface relative to the size."""
        points = thinned(points, self.side)
        off = cKDTree(self.seen).query(points, workers=2)[0] / self.size
        missing = cKDTree(points).query(self.shared, workers=2)[0] / self.size
        out = {}
        for limit in TOLERANCES:
            precision, recall = float((off <= limit).mean()), float((missing <= limit).mean())
            out |= {
                f"precision {100 * limit:g} %": precision,
                f"recall {100 * limit:g} %": recall,
                f"F {100 * limit:g} %": 2 * precision * recall / max(precision + recall, 1e-9),
            }
        return out | {"median distance": float(np.median(off))}


def thinned(points: np.ndarray, side: float) -> np.ndarray:
    """One point of each voxel."""
    keys = np.floor(points / side).astype(np.int64) + (1 << 20)
    _, first = np.unique((keys[:, 0] << 42) | (keys[:, 1] << 21) | keys[:, 2], return_index=True)
    return points[first]


def sampled(vertices: np.ndarray, faces: np.ndarray, side: float) -> np.ndarray:
    """Points on a mesh, about four in each voxel that it crosses."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    rng = np.random.default_rng(0)
    count = int(min(4.0 * area.sum() / side**2, 2e7))
    chosen = rng.choice(len(faces), count, p=area / area.sum())
    u, v = rng.uniform(size=(2, count, 1))
    root = np.sqrt(u)
    return np.asarray((1 - root) * a[chosen] + root * (1 - v) * b[chosen] + root * v * c[chosen])


def cloud_part(work: Path, _data: Path) -> dict[str, dict[str, float]]:
    """Scores of the cloud and of the mesh of each scene, and times."""
    rows = {}
    for name in PLANS:
        scene = prepare_scene(name, work)
        out = work / "surface" / scene.folder.name
        shutil.rmtree(out, ignore_errors=True)
        summary = epipole.surface(scene.folder, out, until="mesh", threads=2).summary
        truth, times = Truth(scene), summary["timings_s"]
        columns = ply_columns(out / "cloud.ply")
        points = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
        mesh = read_mesh_ply(out / "mesh.ply")
        facts = {"size": truth.size, "points": float(len(points)), "triangles": float(len(mesh.faces))}
        seconds = {f"{stage}, s": times[stage] for stage in ("depth", "cloud", "mesh")}
        rate = len(points) / (times["depth"] + times["cloud"])
        rows[f"{name}, cloud"] = facts | truth.scores(points) | seconds | {"points per s": rate}
        surface = sampled(mesh.xyz, mesh.faces, truth.side)
        rows[f"{name}, mesh"] = truth.scores(surface) | {"voxel": summary["voxel"] / truth.size}
    return rows


def units_of(scene: SurfaceScene, out: Path) -> tuple[SurfaceInputs, dict[int, Unit], dict[int, Unit]]:
    """Inputs of a finished run, and the files of its depths and clouds."""
    job = Job(kind="surface", inputs=(scene.folder,), settings={"config": {}})
    with open_run(job, out.parent / f"{out.name}_units") as run:
        inputs = surface_inputs(scene.folder, run, SurfaceConfig())
    depths = depth_units(inputs, out / "units" / "depth")
    return inputs, depths, cloud_units(inputs, depths, out / "units" / "cloud")


def peers_part(work: Path, _data: Path, python: str) -> dict[str, dict[str, float]]:
    """Open3D's TSDF of epipole's confirmed depths with the same voxels, and its Poisson surface of epipole's cloud."""
    rows: dict[str, dict[str, float]] = {}
    for name in PLANS:
        scene = prepare_scene(name, work)
        out = work / "surface" / scene.folder.name
        epipole.surface(scene.folder, out, until="mesh", threads=2)  # continues that of the part `cloud`
        inputs, depths, clouds = units_of(scene, out)
        folder = work / "peers" / scene.folder.name
        folder.mkdir(parents=True, exist_ok=True)
        depth = np.stack([np.nan_to_num(confirmed_depth(depths[k], clouds[k]).depth) for k in depths])
        poses = np.stack([inputs.views[k].cam_from_world.as_matrix() for k in depths])
        columns = ply_columns(out / "cloud.ply")
        cloud = {
            axes: np.stack([columns[axis] for axis in axes.split()], axis=1).astype(np.float64)
            for axes in ("x y z", "nx ny nz")
        }
        voxel = json.loads((out / "summary.json").read_text())["voxel"]
        arrays = {"depth": depth, "poses": poses, "K": scene.camera.K, "voxel": voxel}
        np.savez(folder / "input.npz", **arrays, xyz=cloud["x y z"], normals=cloud["nx ny nz"])
        truth = Truth(scene)
        for method in ("tsdf", "poisson"):
            rows[f"{name}, Open3D {method}"] = _peer(method, folder, python, truth)
    return rows


def _peer(method: str, folder: Path, python: str, truth: Truth) -> dict[str, Any]:
    """Scores of a method of `benchmarks/peers/open3d_surface.py`, in its own process."""
    script = REPOSITORY / "benchmarks" / "peers" / "open3d_surface.py"
    words = [python, str(script), method, str(folder / "input.npz"), str(folder / f"{method}.npz")]
    found = subprocess.run(words, capture_output=True, text=True, check=False)
    if found.returncode:
        return {"error": found.stderr.strip().splitlines()[-1]}
    with np.load(folder / f"{method}.npz") as stored:
        if not len(stored["faces"]):
            return {"error": "there is no surface"}
        scores = truth.scores(sampled(stored["vertices"], stored["faces"], truth.side))
        return scores | {"triangles": float(len(stored["faces"])), "seconds": float(stored["seconds"])}


def memory_part(work: Path, views: int) -> dict[str, dict[str, float]]:
    """Peak memory of `epipole surface --until cloud` on images of 12 megapixels: half of the views, and all."""
    scene = prepare_scene("courtyard", work, LARGE, LARGE_VIEWS)
    rows, depths = {}, []
    for count in (max(views // 2, LARGE_VIEWS), views):
        model = write_copies(scene, count, work / f"copies_{count}")
        out = work / "surface" / f"copies_{count}"
        shutil.rmtree(out, ignore_errors=True)
        command = [sys.executable, "-m", "epipole", "surface", str(model), str(out), "--until", "cloud", "-q"]
        found = run_measured(command, work / f"copies_{count}.log", 2)
        if found.exit_code:
            raise RuntimeError(f"the run failed: see {work / f'copies_{count}.log'}")
        summary = json.loads((out / "summary.json").read_text())
        first = sorted(path.name for path in (out / "units" / "depth").glob("*.npz"))
        depths.append({name: depth_in(out / "units" / "depth" / name).depth for name in first})
        rows[f"{count} views"] = {
            "peak memory, MB": float(found.peak_memory_mb or np.nan),
            "seconds": found.wall_s,
            "depth, s per view": summary["timings_s"]["depth"] / count,
            "cloud, s per view": summary["timings_s"]["cloud"] / count,
            "points": float(summary["num_points"]),
        }
    common = depths[0].keys() & depths[1].keys()
    same = [np.array_equal(depths[0][name], depths[1][name], equal_nan=True) for name in common]
    rows[f"{views} views"] |= {"views of both": float(len(common)), "equal depth": float(np.mean(same))}
    return rows
