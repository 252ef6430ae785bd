"""An argument or option of a name that no job has is refused, with the name that was meant."""

import inspect

import numpy as np
import pytest

import epipole
from epipole.errors import EpipoleError
from epipole.features import match_descriptors
from epipole.geometry import align_points
from epipole.lesson.run import export_lesson
from epipole.pipelines.demo.run import demo
from epipole.pipelines.fields.comparison import compare_fields
from epipole.pipelines.stereo.run import examine_stereo, stereo_many

MORE = {job.__name__: job for job in (compare_fields, demo, examine_stereo, export_lesson, stereo_many)}
"""Jobs that the package itself does not list."""


@pytest.mark.parametrize(
    ("job", "wrong", "meant"),
    [
        ("splat", "tiem", "time"),
        ("splat", "max_gausians", "max_gaussians"),
        ("splat", "progres", "progress"),
        ("nerf", "stpes", "steps"),
        ("nerf", "kinds", "kind"),
        ("compare_fields", "max_side", "max_side_px"),
        ("slam", "max_frame", "max_frames"),
        ("slam", "tag_size", "tag_size_m"),
        ("slam", "camera_parms", "camera_params"),
        ("slam", "max_errors_px", "max_error_px"),
        ("reconstruct", "single_cam", "single_camera"),
        ("reconstruct", "exekutor", "executor"),
        ("render", "witdh", "width"),
        ("render", "progess", "progress"),
        ("mesh", "voxel", "voxels"),
        ("stereo", "rigs", "rig"),
        ("stereo_many", "prgress", "progress"),
        ("calibrate", "colums", "columns"),
        ("calibrate", "rigth", "right"),
        ("evaluate", "thruth", "truth"),
        ("evaluate_trajectory", "max_diference_s", "max_difference_s"),
        ("undistort", "traget", "target"),
        ("convert", "fromat", "format"),
        ("view", "prot", "port"),
        ("share", "share_mx", "share_max"),
        ("demo", "num_view", "num_views"),
        ("export_lesson", "folders", "folder"),
        ("examine_stereo", "max_frame", "max_frames"),
    ],
)
def test_the_name_that_was_meant_is_suggested(job, wrong, meant, tmp_path):
    function = MORE.get(job) or getattr(epipole, job)
    needed = [
        parameter
        for parameter in inspect.signature(function).parameters.values()
        if parameter.default is parameter.empty and parameter.kind is parameter.POSITIONAL_OR_KEYWORD
    ]
    with pytest.raises(EpipoleError, match=rf"has no (option|argument) {wrong}; did you mean .*\b{meant}\b"):
        function(*[tmp_path / "no"] * len(needed), **{wrong: 1})
    assert not list(tmp_path.iterdir())


def test_a_name_like_no_other_lists_what_there_is(tmp_path):
    with pytest.raises(
        EpipoleError,
        match=r"SplatConfig has no option xyzzy; it has time, .*; the job also takes config, progress",
    ):
        epipole.splat(tmp_path, tmp_path / "out", xyzzy=1)
    with pytest.raises(EpipoleError, match=r"convert has no argument xyzzy; it has source, target, format"):
        epipole.convert(tmp_path, tmp_path / "out", xyzzy=1)


def test_functions_on_arrays_refuse_it_too():
    with pytest.raises(
        EpipoleError, match=r"align_points has no argument with_scal; did you mean with_scale\?"
    ):
        align_points(np.zeros((3, 3)), np.zeros((3, 3)), with_scal=True)
    with pytest.raises(EpipoleError, match=r"match_descriptors has no argument"):
        match_descriptors(nosuch=1)
