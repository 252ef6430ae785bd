"""Surfaces whose run is killed, or whose disk is full, in each stage: no file is half written, and the next run continues."""

import errno
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pyogrio
import pytest
from benchmarks.tasks.surfaces import prepare_scene

from epipole import surface
from epipole.errors import WorkspaceError
from epipole.io.colmap.model import read_colmap_model, write_colmap_model
from epipole.io.meshes.gltf import read_glb
from epipole.io.meshes.mesh_ply import read_mesh_ply
from epipole.io.meshes.ply import read_points_ply
from epipole.scene import Georeference
from whole import IS_WHOLE, in_whole_run

OPTIONS = {"max_size_px": 192, "texture_px": 1024, "until": "survey"}
KILLED = """
import os, signal, sys
from epipole import surface
import {module} as module
from whole import IS_WHOLE, in_whole_run

def killed(path, *args, **options):
    with open(path, "wb") as file:
        file.write(b"half a file")
    os.kill(os.getpid(), signal.SIGKILL)

module.{function} = killed
surface({source!r}, {out!r}, **{options!r})
"""
STAGES = [
    ("epipole.pipelines.surfaces.cloud_files", "write_cloud_ply", ()),
    ("epipole.pipelines.surfaces.run", "write_mesh_ply", ("cloud.ply",)),
    ("epipole.pipelines.surfaces.texture_stage", "write_glb", ("cloud.ply", "mesh.ply")),
    (
        "epipole.pipelines.surfaces.cloud_files",
        "write_laz_chunks",  # the last of the stage
        ("cloud.ply", "mesh.ply", "textured.glb"),
    ),
]
"""Module and name of the function in which the process is killed, and the files that are complete then."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    scene = prepare_scene("courtyard", tmp_path_factory.mktemp("interrupted"), (384, 256), 6)
    folder = scene.folder / "sparse" / "0"
    write_colmap_model(
        replace(read_colmap_model(folder), georeference=Georeference(48.2, 11.6, 520.0)), folder
    )
    return scene


@pytest.fixture(scope="module")
def whole(scene, tmp_path_factory):
    return surface(scene.folder, tmp_path_factory.mktemp("whole") / "out", **OPTIONS)


def results(out):
    suffixes = (".ply", ".glb", ".tif", ".gpkg", ".laz", ".html")
    return sorted(path.name for path in out.iterdir() if path.suffix in suffixes)


def check_same(out, whole):
    for name in ("cloud.ply", "mesh.ply", "dsm.tif", "dtm.tif", "orthophoto.tif", "cloud.laz"):
        assert (out / name).read_bytes() == (whole.out / name).read_bytes(), name
    lines = [
        pyogrio.raw.read(folder / "contours.gpkg") for folder in (out, whole.out)
    ]  # the file has its time
    for found, wanted in zip(*((geometry, *fields) for _, _, geometry, fields in lines)):
        np.testing.assert_array_equal(found, wanted)
    found, wanted = read_glb(out / "textured.glb"), read_glb(whole.out / "textured.glb")
    np.testing.assert_array_equal(found.textures[0], wanted.textures[0])


@in_whole_run
def test_a_run_killed_in_each_stage_leaves_whole_files_and_continues(scene, whole, tmp_path):
    out = tmp_path / "out"
    for module, function, complete in STAGES:
        script = KILLED.format(
            module=module, function=function, source=str(scene.folder), out=str(out), options=OPTIONS
        )
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
        assert done.returncode == -9, done.stderr.decode()[-500:]
        assert results(out) == list(complete)
    assert len(read_points_ply(out / "cloud.ply").xyz) and len(read_mesh_ply(out / "mesh.ply").faces)
    surface(scene.folder, out, **OPTIONS)
    check_same(out, whole)
    files = [path for path in out.rglob("*") if path.is_file()]
    assert not [path for path in files if path.read_bytes() == b"half a file"]


@pytest.mark.parametrize(("module", "function", "complete"), STAGES if IS_WHOLE else STAGES[-1:])
def test_a_full_disk_is_named_and_the_next_run_continues(
    scene, whole, tmp_path, monkeypatch, module, function, complete
):
    def full(path, *args, **options):
        raise WorkspaceError(f"cannot write {path}: {os.strerror(errno.ENOSPC)}")

    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(f"{module}.{function}", full)
        with pytest.raises(WorkspaceError, match="No space left"):
            surface(scene.folder, out, **OPTIONS)
    assert results(out) == list(complete)
    surface(scene.folder, out, **OPTIONS)
    check_same(out, whole)


@pytest.mark.skipif(sys.platform == "win32", reason="file size limits are POSIX")
def test_a_file_that_cannot_grow_is_said_and_none_is_left_half(scene, whole, tmp_path):
    """As on a full disk, a write in the middle of a file fails while the depths are fused."""
    import resource

    out, options = tmp_path / "out", {**OPTIONS, "until": "cloud"}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, ((whole.out / "cloud.ply").stat().st_size // 2, limits[1]))
    try:
        with pytest.raises(WorkspaceError, match=r"cannot write .*cloud"):
            surface(scene.folder, out, **options)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not (out / "cloud.ply").exists() and list((out / "units" / "depth").iterdir())
    assert not [path for path in out.rglob("*") if ".part" in path.name or path.suffix == ".tmp"]
    surface(scene.folder, out, **options)
    assert (out / "cloud.ply").read_bytes() == (whole.out / "cloud.ply").read_bytes()
