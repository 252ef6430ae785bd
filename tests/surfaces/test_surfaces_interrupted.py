"""Surfaces whose run is killed, or whose disk is full, in each stage: no file is half written, and the next run continues."""

import errno
import os
import subprocess
import sys

import numpy as np
import pytest
from benchmarks.tasks.surfaces import prepare_scene

from epipole import surface
from epipole.errors import WorkspaceError
from epipole.io.meshes.gltf import read_glb
from epipole.io.meshes.mesh_ply import read_mesh_ply
from epipole.io.meshes.ply import read_points_ply

OPTIONS = {"max_size_px": 192, "texture_px": 1024}
KILLED = """
import os, signal, sys
from epipole import surface
import {module} as module

def killed(path, *args, **options):
    with open(path, "wb") as file:
        file.write(b"half a file")
    os.kill(os.getpid(), signal.SIGKILL)

module.{function} = killed
surface({source!r}, {out!r}, max_size_px=192, texture_px=1024)
"""
STAGES = [
    ("epipole.pipelines.surfaces.run", "write_cloud_ply", ()),
    ("epipole.pipelines.surfaces.run", "write_mesh_ply", ("cloud.ply",)),
    ("epipole.pipelines.surfaces.texture_stage", "write_glb", ("cloud.ply", "mesh.ply")),
]
"""Module and name of the function in which the process is killed, and the files that are complete then."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return prepare_scene("courtyard", tmp_path_factory.mktemp("interrupted"), (384, 256), 6)


@pytest.fixture(scope="module")
def whole(scene, tmp_path_factory):
    return surface(scene.folder, tmp_path_factory.mktemp("whole") / "out", **OPTIONS)


def results(out):
    return sorted(path.name for path in out.iterdir() if path.suffix in (".ply", ".glb", ".html"))


def check_same(out, whole):
    assert (out / "cloud.ply").read_bytes() == (whole.out / "cloud.ply").read_bytes()
    assert (out / "mesh.ply").read_bytes() == (whole.out / "mesh.ply").read_bytes()
    found, wanted = read_glb(out / "textured.glb"), read_glb(whole.out / "textured.glb")
    np.testing.assert_array_equal(found.textures[0], wanted.textures[0])


def test_a_run_killed_in_each_stage_leaves_whole_files_and_continues(scene, whole, tmp_path):
    out = tmp_path / "out"
    for module, function, complete in STAGES:
        script = KILLED.format(module=module, function=function, source=str(scene.folder), out=str(out))
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
        assert done.returncode == -9, done.stderr.decode()[-500:]
        assert results(out) == list(complete)
    assert len(read_points_ply(out / "cloud.ply").xyz) and len(read_mesh_ply(out / "mesh.ply").faces)
    surface(scene.folder, out, **OPTIONS)
    check_same(out, whole)
    files = [path for path in out.rglob("*") if path.is_file()]
    assert not [path for path in files if path.read_bytes() == b"half a file"]


@pytest.mark.parametrize(("module", "function", "complete"), STAGES)
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
