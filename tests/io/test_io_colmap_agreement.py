"""pycolmap reads what we write, and we read what it writes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pycolmap_process import needs_pycolmap, run_pycolmap

from epipole.io import read_colmap_model, write_colmap_model
from io_models import small_model

DESCRIBE = """
    model = pycolmap.Reconstruction(args[0])
    images = {}
    for image in model.images.values():
        images[image.image_id] = {
            "name": image.name, "camera": image.camera_id, "frame": image.frame_id,
            "cam_from_world": image.cam_from_world().matrix().tolist(),
            "keypoints": [p.xy.tolist() for p in image.points2D],
            "points": [p.point3D_id if p.has_point3D() else -1 for p in image.points2D],
        }
    points = {
        i: {"xyz": p.xyz.tolist(), "rgb": p.color.tolist(), "error": p.error,
            "track": sorted((e.image_id, e.point2D_idx) for e in p.track.elements)}
        for i, p in model.points3D.items()
    }
    cameras = {i: [c.model.name, c.width, c.height, c.params.tolist()] for i, c in model.cameras.items()}
    rigs = {i: sorted(s.id for s in rig.sensor_ids()) for i, rig in model.rigs.items()}
    stored = model.compute_mean_reprojection_error()
    model.update_point_3d_errors()
    print(json.dumps({"images": images, "points": points, "cameras": cameras, "rigs": rigs, "stored": stored,
                      "computed": model.compute_mean_reprojection_error()}))
"""


@needs_pycolmap
@pytest.mark.parametrize("text", [False, True])
def test_pycolmap_reads_what_we_write(tmp_path: Path, text: bool) -> None:
    model = small_model()
    write_colmap_model(model, tmp_path, text=text)
    theirs = run_pycolmap(DESCRIBE, tmp_path)
    assert sorted(map(int, theirs["images"])) == list(range(1, 9))
    point_of_keypoint = model.point_of_keypoint()
    for i in range(8):
        image = theirs["images"][str(i + 1)]
        # COLMAP's text reader takes names up to the first space only.
        assert image["name"] == (model.images.name[i].split()[0] if text else model.images.name[i])
        assert image["camera"] == model.camera_of_image[i] + 1
        assert image["frame"] == model.images.frame[i] + 1
        expected = model.cams_from_world()[i].as_matrix()[:3]
        np.testing.assert_allclose(image["cam_from_world"], expected, atol=1e-12)
        np.testing.assert_allclose(image["keypoints"], model.images.keypoints_of(i) + 0.5, atol=1e-12)
        rows = slice(model.images.keypoint_offsets[i], model.images.keypoint_offsets[i + 1])
        ids = point_of_keypoint[rows]
        np.testing.assert_array_equal(image["points"], np.where(ids < 0, -1, ids + 1))
    assert len(theirs["points"]) == len(model.points)
    for j in range(len(model.points)):
        point, rows = (
            theirs["points"][str(j + 1)],
            slice(model.tracks.offsets[j], model.tracks.offsets[j + 1]),
        )
        np.testing.assert_array_equal(point["xyz"], model.points.xyz_in_world[j])
        np.testing.assert_array_equal(point["rgb"], model.points.rgb[j])
        track = sorted(zip((model.tracks.image[rows] + 1).tolist(), model.tracks.keypoint[rows].tolist()))
        assert [tuple(e) for e in point["track"]] == track
    for c, (name, width, height, params) in enumerate(theirs["cameras"][str(c + 1)] for c in range(3)):
        mine = model.cameras[c]
        assert (name, width, height) == (mine.model.name, mine.width, mine.height)
        half = np.zeros(len(params))
        half[list(mine.model.principal_point_indices)] = 0.5
        np.testing.assert_allclose(params, mine.params + half, atol=1e-12)
    assert theirs["rigs"] == {"1": [1, 2], "2": [3]}


@needs_pycolmap
def test_reprojection_errors_agree(tmp_path: Path) -> None:
    """Projection, distortion and the half pixel together: the same mean error from both programs."""
    model = small_model()
    write_colmap_model(model, tmp_path)
    theirs = run_pycolmap(DESCRIBE, tmp_path)
    # pycolmap averages over points, not over observations.
    mean = model.points.error_px.mean()
    assert 0.2 < mean < 1.0
    assert abs(theirs["stored"] - mean) < 1e-12
    assert abs(theirs["computed"] - mean) < 1e-9


@needs_pycolmap
@pytest.mark.parametrize("text", [False, True])
def test_we_read_what_pycolmap_writes(tmp_path: Path, text: bool) -> None:
    script = """
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 2, 2
    options.num_frames_per_rig, options.num_points3D = 3, 40
    model = pycolmap.synthesize_dataset(options)
    model.deregister_frame(sorted(model.frames)[-1])
    model.write_text(args[0]) if args[1] == "text" else model.write_binary(args[0])
    registered = [i for i in sorted(model.images) if model.images[i].has_pose]
    print(json.dumps({
        "names": [model.images[i].name for i in registered],
        "poses": [model.images[i].cam_from_world().matrix().tolist() for i in registered],
        "keypoints": [[p.xy.tolist() for p in model.images[i].points2D] for i in registered],
        "xyz": [model.points3D[j].xyz.tolist() for j in sorted(model.points3D)],
        "lengths": [model.points3D[j].track.length() for j in sorted(model.points3D)],
    }))
    """
    theirs = run_pycolmap(script, tmp_path, "text" if text else "bin")
    model = read_colmap_model(tmp_path)
    assert len(model.images) == 10 and len(model.rigs) == 2 and len(model.rigs.sensor_camera) == 4
    assert list(model.images.name) == theirs["names"]
    np.testing.assert_allclose(model.cams_from_world().as_matrix()[:, :3], theirs["poses"], atol=1e-12)
    for i in range(10):
        np.testing.assert_allclose(model.images.keypoints_of(i) + 0.5, theirs["keypoints"][i], atol=1e-9)
    np.testing.assert_array_equal(model.points.xyz_in_world, theirs["xyz"])
    np.testing.assert_array_equal(np.diff(model.tracks.offsets), theirs["lengths"])
    # Synthetic keypoints are exact projections: the half pixel and the rig must be right for this.
    assert model.mean_reprojection_error_px() < 1e-9


@needs_pycolmap
def test_points_without_tracks_can_be_read(tmp_path: Path) -> None:
    model = small_model()
    none = np.zeros(0, np.int32)
    offsets = np.zeros(len(model.points) + 1, np.int64)
    write_colmap_model(
        replace(model, tracks=replace(model.tracks, offsets=offsets, image=none, keypoint=none)), tmp_path
    )
    script = "m = pycolmap.Reconstruction(args[0]); print(json.dumps([len(m.points3D), m.num_reg_images()]))"
    assert run_pycolmap(script, tmp_path) == [len(model.points), 8]
