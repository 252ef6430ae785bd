"""The job: folders of frames to a path, a map and a summary; damaged frames are left out and named."""

import json

import cv2
import numpy as np
import pytest
from slam_rides import CAMERA, ride

from epipole.cli.main import main
from epipole.errors import ConfigError, FileFormatError, NoModelError
from epipole.io import read_colmap_model, read_trajectory
from epipole.io.meshes.mesh_ply import read_mesh_ply
from epipole.metrics import absolute_error, associate
from epipole.pipelines.slam.output.scene import scene as scene_of
from epipole.pipelines.slam.run import slam as run_slam
from epipole.scene import Trajectory
from whole import IS_WHOLE, in_whole_run

PARAMS = ",".join(str(p + 0.5 * (n >= 2)) for n, p in enumerate(CAMERA.params))


@pytest.fixture
def stereo_folder(tmp_path):
    """A KITTI-like folder of twelve rendered pairs."""
    folder = tmp_path / "ride"
    for name, images in (("image_0", ride().left), ("image_1", ride().right)):
        (folder / name).mkdir(parents=True)
        for n, image in enumerate(images[:12]):
            cv2.imwrite(str(folder / name / f"{n:06d}.png"), image)
    f, _, cx, cy = CAMERA.params
    rows = [[f, 0, cx, x, 0, f, cy, 0, 0, 0, 1, 0] for x in (0.0, -f * 0.12)]
    (folder / "calib.txt").write_text(
        "".join(f"P{k}: {' '.join(map(str, row))}\n" for k, row in enumerate(rows))
    )
    return folder


def test_a_folder_becomes_a_path_and_a_map(stereo_folder, tmp_path):
    out = tmp_path / "out"
    result = run_slam(stereo_folder, out)
    assert result.summary["num_localized"] == result.summary["num_frames"] == 12
    assert result.summary["scale"] == "meters, from the baseline of 0.12 m"
    path = read_trajectory(out / "trajectory.txt")
    truth = ride().truth()[np.arange(12)]
    assert absolute_error(path.world_from_body, truth, "none").position.rmse < 0.02
    assert read_trajectory(out / "trajectory_covariance.txt").covariance.shape == (12, 6, 6)
    assert len(read_trajectory(out / "trajectory_causal.txt")) == 12
    model = read_colmap_model(out / "sparse" / "0")
    assert len(model.images) == result.summary["num_keyframes"] and len(model.points) > 100
    assert json.loads((out / "summary.json").read_text())["is_metric"] is True
    before = (out / "trajectory.txt").read_bytes()
    run_slam(stereo_folder, out)
    assert (out / "trajectory.txt").read_bytes() == before


@pytest.mark.usefixtures("unchecked")
def test_a_damaged_frame_is_left_out_and_named(stereo_folder, tmp_path):
    (stereo_folder / "image_0" / "000005.png").write_bytes(b"no image")
    cv2.imwrite(str(stereo_folder / "image_0" / "000007.png"), np.zeros((40, 50), np.uint8))
    result = run_slam(stereo_folder, tmp_path / "out")
    assert result.summary["num_localized"] == 10
    names = read_colmap_model(tmp_path / "out" / "sparse" / "0").images.name
    assert len(set(names)) == len(names) and not {"000005.png", "000007.png"} & set(names)
    assert [w.split(":")[0] for w in result.warnings] == ["frame 5 is left out", "frame 7 is left out"]


def test_one_camera_from_pictures_alone(stereo_folder, tmp_path):
    left = stereo_folder / "image_0"
    result = run_slam(left, tmp_path / "out", camera_params=PARAMS)
    assert result.summary["scale"].startswith("up to scale") and not result.summary["is_metric"]
    for wrong, words in (("1,2", "takes 4 parameters"), ("a,b,c,d", "must be numbers")):
        with pytest.raises(ConfigError, match=words):
            run_slam(left, tmp_path / "out", camera_params=wrong)
    for sensor, words in (("stereo", "no calibrated second camera"), ("rgbd", "no depth images")):
        with pytest.raises(ConfigError, match=words):
            run_slam(left, tmp_path / "out", sensor=sensor, camera_params=PARAMS)


def test_frames_of_nothing_end_with_the_reason(tmp_path):
    (tmp_path / "dark").mkdir()
    for n in range(3):
        cv2.imwrite(str(tmp_path / "dark" / f"{n}.png"), np.zeros((240, 320), np.uint8))
    with pytest.raises(NoModelError, match=r"no frame was localized: .*blank"):
        run_slam(tmp_path / "dark", tmp_path / "out", camera_params=PARAMS)
    with pytest.raises(FileFormatError, match="it does not exist"):
        run_slam(tmp_path / "nothing", tmp_path / "out")


def test_the_command(stereo_folder, tmp_path, capsys):
    main(["slam", str(stereo_folder), str(tmp_path / "out"), "--num-features", "200"])
    said = capsys.readouterr().out
    assert "12 of 12 (12 when they arrived)" in said and "meters, from the baseline of 0.12 m" in said


def check_kitchen_mesh(folder, result):
    """The mesh agrees with the depth image of the last frame, on most of its pixels."""
    mesh = read_mesh_ply(result.out / "mesh.ply")
    assert (
        len(mesh.faces) == result.summary["mesh"]["num_faces"] > 50_000
        and scene_of(result.out).mesh is not None
    )
    last = sorted(folder.glob("*.depth.png"))[len(result.trajectory) - 1]
    depth = cv2.imread(str(last), cv2.IMREAD_UNCHANGED).astype(float) / 1000.0
    in_cam = result.trajectory.world_from_body[-1].inverse().apply(mesh.xyz)
    u, v = np.rint(in_cam[:, :2] / in_cam[:, 2:] * 585.0 + [319.5, 239.5]).astype(int).T
    inside = (in_cam[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < 640) & (v < 480)
    measured = depth[v[inside], u[inside]]
    known = (measured > 0) & (measured < 8)
    near = np.abs(in_cam[inside, 2] - measured)[known] < 0.06
    assert known.sum() > 30_000 and near.mean() > 0.75


KITCHEN = [("rgbd", 100, "rigid"), ("mono", 100, "similarity")] if IS_WHOLE else [("rgbd", 30, "rigid")]


@pytest.mark.parametrize(("sensor", "count", "alignment"), KITCHEN)
def test_the_kitchen(data_dir, tmp_path, sensor, count, alignment):
    """7-Scenes, the first frames against poses by structure-from-motion."""
    folder = tmp_path / "kitchen"
    folder.mkdir()
    for path in sorted((data_dir / "slam" / "7scenes").glob("frame-0000*")) + sorted(
        (data_dir / "slam" / "7scenes").glob("frame-0001*")
    ):
        (folder / path.name).symlink_to(path)
    result = run_slam(folder, tmp_path / "out", sensor=sensor, max_frames=count, mesh=sensor == "rgbd")
    assert result.summary["num_localized"] == result.summary["num_frames"] == count
    if sensor == "rgbd":
        check_kitchen_mesh(folder, result)
    rows = np.loadtxt(data_dir / "slam" / "7scenes" / "poses_sfm.txt")
    (tmp_path / "truth.txt").write_text(
        "\n".join(" ".join(map(str, [row[0] / 30, *row[1:]])) for row in rows), encoding="utf-8"
    )
    truth = read_trajectory(tmp_path / "truth.txt")
    ours, theirs = associate(result.trajectory, truth)
    found = absolute_error(result.trajectory.world_from_body[ours], truth.world_from_body[theirs], alignment)
    assert isinstance(result.causal, Trajectory) and found.position.rmse < 0.02


def test_a_resting_drone_rests(data_dir, tmp_path):
    """Its folder brings the truth, which is that of the IMU; the camera's is made of it."""
    drone = data_dir / "slam" / "euroc_static"
    result = run_slam(drone, tmp_path / "out", truth=drone)
    assert result.summary["num_localized"] == 6 and result.trajectory.path_length() < 2e-3
    assert any(w.startswith("the camera is at rest: ") for w in result.warnings)
    assert result.summary["truth"]["final"]["rigid"]["ate_rmse"] < 5e-4


@in_whole_run
def test_a_mesh_of_an_earlier_run_does_not_stay(data_dir, tmp_path):
    source = data_dir / "slam" / "kitti06_stereo"
    with_mesh = run_slam(source, tmp_path / "out", mesh=True, max_frames=4)
    assert (tmp_path / "out" / "mesh.ply").is_file() == ("mesh" in with_mesh.summary)
    assert "mesh" in with_mesh.summary or any("there is no mesh" in words for words in with_mesh.warnings)
    run_slam(source, tmp_path / "out", max_frames=4)
    assert not (tmp_path / "out" / "mesh.ply").exists()


def test_a_mesh_has_the_colors_of_the_frames(data_dir, tmp_path):
    found = run_slam(data_dir / "slam" / "7scenes", tmp_path / "out", mesh=True, max_frames=12)
    assert found.summary["mesh"]["num_faces"] > 10_000
    rgb = read_mesh_ply(tmp_path / "out" / "mesh.ply").rgb.astype(int)
    red = rgb[:, 0] - rgb[:, 2]
    assert rgb.std() > 20 and (np.abs(red) > 20).mean() > 0.05  # the kitchen's red cupboards, among others


def test_a_mesh_needs_depth(data_dir, tmp_path):
    with pytest.raises(ConfigError, match="mesh needs a depth sensor or a stereo pair"):
        run_slam(data_dir / "slam" / "kitti00_mono", tmp_path / "out", mesh=True, max_frames=3)
