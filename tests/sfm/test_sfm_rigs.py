"""Rigs with known and constant geometry: assignment of images, scale, estimated geometry, and rigs that contradict the images."""

import json
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from photographs import CAMERA, FOCAL_35MM, neighboring_views

from epipole import reconstruct
from epipole.cameras import Camera
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3, Rotation3, Similarity3
from epipole.io.colmap.model import read_colmap_model
from epipole.io.colmap.rig_config import RigConfig, RigSensor, read_rig_config
from epipole.io.images.name_patterns import NamePattern
from epipole.io.images.photographs import write_jpeg_with_exif
from epipole.mapping import adjust_reconstruction
from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.rigs.assignment import assign_images
from epipole.pipelines.sfm.rigs.lengths import CALIBRATION_SIGMA
from epipole.pipelines.sfm.rigs.rig_model import with_rigs
from epipole.scale import ScaleEstimate
from epipole.scene import Georeference, Reconstruction
from epipole.synthetic import courtyard, render
from whole import IS_WHOLE

PINHOLE = Camera("PINHOLE", 640, 480, [500.0, 500.0, 319.5, 239.5])
NUM_FRAMES, NOISE_PX = 12, 0.5
GEOMETRY = Rigid3(
    np.stack(
        [
            Rotation3.exp(np.array(v)).matrix
            for v in ([0, 0, 0], [0, 0.02, 0.01], [0.1, -0.3, 0], [0, 0.4, 0.05])
        ]
    ),
    np.array([[0.0, 0, 0], [-0.54, 0.01, 0.02], [0.2, 0.3, 0.0], [0.4, -0.1, 0.1]]),
)
SEEDS = 12 if IS_WHOLE else 5


@cache
def mapped(seed: int) -> tuple[Reconstruction, Rigid3]:
    """Independent images of a rig of four cameras, up to a similarity, and the true poses of the frames."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(-0.6, 0.6, NUM_FRAMES)
    centers = np.stack([9 * np.sin(angles), 0.5 * np.sin(5 * angles), -9 * np.cos(angles)], axis=1)
    turn = Rotation3.exp(
        np.stack([0 * angles, angles, 0 * angles], axis=1) + 0.03 * rng.normal(size=(NUM_FRAMES, 3))
    )
    frames = Rigid3(turn.matrix, -np.einsum("nij,nj->ni", turn.matrix, centers))
    points = rng.uniform(-4, 4, (700, 3))
    image, point, pixels, poses, names = [], [], [], [], []
    for s in range(4):
        for f in range(NUM_FRAMES):
            pose = GEOMETRY[s] @ frames[f]
            at = PINHOLE.project(pose.apply(points))
            own = np.flatnonzero(((at > 0) & (at < (639, 479))).all(axis=1))
            image += [len(poses)] * len(own)
            point += own.tolist()
            pixels.append(at[own] + NOISE_PX * rng.normal(size=(len(own), 2)))
            poses.append(pose)
            names.append(f"cam{s}/{f:03d}.png")
    cams = Rigid3(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses]))
    cameras = [PINHOLE] * len(names)
    exact = Reconstruction.from_observations(
        cams, cameras, points, np.array(image), np.array(point), np.concatenate(pixels), names
    )
    exact = replace(exact, cameras=replace(exact.cameras, is_constant=np.ones(len(names), bool)))
    model, _ = adjust_reconstruction(_of_four_cameras(exact))
    anywhere = Similarity3(np.asarray(0.13), Rotation3.exp(rng.normal(size=3)).matrix, 5 * rng.normal(size=3))
    return model.transformed(anywhere), frames


def _of_four_cameras(model: Reconstruction) -> Reconstruction:
    """One camera for each sensor instead of one for each image."""
    rows = np.arange(4) * NUM_FRAMES
    cameras = type(model.cameras)(**{n: getattr(model.cameras, n)[rows] for n in model.cameras.__slots__})
    rigs = type(model.rigs).of_single_cameras(4)
    sensor = np.repeat(np.arange(4, dtype=np.int32), NUM_FRAMES)
    frames = replace(model.frames, rig=sensor)
    return replace(
        model, cameras=cameras, rigs=rigs, frames=frames, images=replace(model.images, sensor=sensor)
    )


def rig(geometry: list[Rigid3 | None]) -> RigConfig:
    return RigConfig(
        tuple(RigSensor(NamePattern(f"cam{s}/"), pose, None, ()) for s, pose in enumerate(geometry))
    )


KNOWN = rig([GEOMETRY[s] for s in range(4)])
UNKNOWN = rig([Rigid3.identity(), None, None, None])


def rigged(seed: int, config: RigConfig):
    model, frames = mapped(seed)
    return with_rigs(model, assign_images(model.images.name, [config]), MapperConfig()), frames


def test_known_geometry_gives_meters():
    ratios = []
    for seed in range(SEEDS):
        found, frames = rigged(seed, KNOWN)
        assert found.scale is not None and not [n for n in found.notes if "not used" in n]
        assert len(found.model.rigs) == 1 and len(found.model.rigs.sensor_camera) == 4
        true = frames.centers()
        ends = found.model.frames.rig_from_world.centers()
        rows = [
            found.model.images.frame[found.model.images.name.index(f"cam0/{f:03d}.png")]
            for f in (0, NUM_FRAMES - 1)
        ]
        length, expected = np.linalg.norm(ends[rows[1]] - ends[rows[0]]), np.linalg.norm(true[-1] - true[0])
        images_alone = np.sqrt(
            found.scale.sigma**2 - CALIBRATION_SIGMA**2
        )  # the given geometry is exact here
        ratios.append((length / expected - 1.0) / images_alone)
        assert abs(length / expected - 1.0) < 2.0 * found.scale.sigma
    assert (np.abs(ratios) < 3.0).all() and np.sqrt(np.mean(np.square(ratios))) < 2.0
    cams = found.model.cams_from_world()
    relative = (
        cams[found.model.images.name.index("cam1/004.png")]
        @ cams[found.model.images.name.index("cam0/004.png")].inverse()
    )
    np.testing.assert_allclose(relative.translation, GEOMETRY.translation[1], atol=1e-9)


def test_unknown_geometry_is_estimated_with_its_standard_deviation():
    ratios = []
    for seed in range(SEEDS):
        found, _ = rigged(seed, UNKNOWN)
        assert found.scale is None and set(found.geometry) == {f"cam{s}/" for s in range(4)}
        unit = found.geometry["cam1/"]["cam_from_rig_translation"]
        scale = np.linalg.norm(GEOMETRY.translation[1]) / np.linalg.norm(unit)
        for s in (2, 3):
            entry = found.geometry[f"cam{s}/"]
            rotation = Rotation3.from_quat_wxyz(np.array(entry["cam_from_rig_rotation"])).matrix
            off_deg = np.degrees(np.linalg.norm(Rotation3(rotation @ GEOMETRY.rotation[s].T).log()))
            assert off_deg < 0.3
            ratios.append(off_deg / entry["rotation_sigma_deg"])
            off = scale * np.array(entry["cam_from_rig_translation"]) - GEOMETRY.translation[s]
            assert np.linalg.norm(off) < 0.03
    assert np.sqrt(np.mean(np.square(ratios))) < 2.0  # of three components, sigma is the largest


def test_an_image_that_was_not_registered_gets_its_pose_from_the_rig():
    model, _ = mapped(0)
    lost = model.images.name.index("cam2/005.png")
    translation = model.frames.rig_from_world.translation.copy()
    translation[model.images.frame[lost]] = np.nan
    keep = model.tracks.image != lost
    counts = np.bincount(model.tracks.point_of_observation()[keep], minlength=len(model.points))
    tracks = type(model.tracks)(
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        model.tracks.image[keep],
        model.tracks.keypoint[keep],
    )
    poses = Rigid3(model.frames.rig_from_world.rotation, translation)
    model = replace(model, frames=replace(model.frames, rig_from_world=poses), tracks=tracks)
    found = with_rigs(model, assign_images(model.images.name, [KNOWN]), MapperConfig())
    assert found.model.is_registered().all()
    assert any("1 images get their pose" in note for note in found.notes)


def test_known_geometry_without_a_common_frame_is_not_used():
    """Otherwise lengths of meters would be mixed with those of a model without scale."""
    model, _ = mapped(0)
    names = [
        name.replace("cam1/", "cam1/other_") if name.startswith("cam1/") else name
        for name in model.images.name
    ]
    model = replace(model, images=replace(model.images, name=tuple(names)))
    config = rig([GEOMETRY[0], GEOMETRY[1]])
    found = with_rigs(model, assign_images(names, [config]), MapperConfig())
    assert found.scale is None and any("no frame has it and the reference" in note for note in found.notes)


def test_images_of_two_cameras_are_no_sensor():
    """Otherwise all of them would get the intrinsics of the first."""
    model, _ = mapped(0)
    sensor = model.images.sensor.copy()
    sensor[model.images.name.index("cam1/003.png")] = 2
    mixed = replace(model, images=replace(model.images, sensor=sensor))
    found = with_rigs(mixed, assign_images(mixed.images.name, [KNOWN]), MapperConfig())
    assert any("cam1/" in note and "of 2 cameras" in note for note in found.notes)
    assert "cam1/" not in found.geometry and "cam2/" in found.geometry


def test_one_instant_of_a_pair_has_a_finite_standard_deviation():
    model, _ = mapped(0)
    names = [name if name.endswith("005.png") and name < "cam2" else f"x{name}" for name in model.images.name]
    poses = model.frames.rig_from_world
    hidden = np.array([name.startswith("x") for name in names])
    translation = poses.translation.copy()
    translation[model.images.frame[hidden]] = np.nan
    keep = ~hidden[model.tracks.image]
    counts = np.bincount(model.tracks.point_of_observation()[keep], minlength=len(model.points))
    tracks = type(model.tracks)(
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        model.tracks.image[keep],
        model.tracks.keypoint[keep],
    )
    model = replace(
        model,
        frames=replace(model.frames, rig_from_world=Rigid3(poses.rotation, translation)),
        images=replace(model.images, name=tuple(names)),
        tracks=tracks,
    )
    found = with_rigs(model, assign_images(names, [rig([GEOMETRY[0], GEOMETRY[1]])]), MapperConfig())
    assert found.scale is not None and found.scale.sigma == pytest.approx(CALIBRATION_SIGMA)
    centers = found.model.camera_centers_in_world()[~hidden]
    np.testing.assert_allclose(
        np.linalg.norm(centers[1] - centers[0]), np.linalg.norm(GEOMETRY.translation[1])
    )


def test_two_frames_of_a_pair_give_meters():
    model, frames = mapped(0)
    names = [f"x{name}" if int(name[5:8]) > 1 else name for name in model.images.name]
    model = replace(model, images=replace(model.images, name=tuple(names)))
    found = with_rigs(model, assign_images(names, [rig([GEOMETRY[0], GEOMETRY[1]])]), MapperConfig())
    assert found.scale is not None
    centers = found.model.camera_centers_in_world()
    length = np.linalg.norm(centers[names.index("cam0/001.png")] - centers[names.index("cam0/000.png")])
    assert abs(length / np.linalg.norm(frames.centers()[1] - frames.centers()[0]) - 1.0) < 0.1


def test_a_rig_that_contradicts_the_images_is_not_used():
    model, _ = mapped(0)
    rotated = Rigid3(
        Rotation3.exp(np.array([0.2, 0.0, 0.0])).matrix @ GEOMETRY.rotation[1], GEOMETRY.translation[1]
    )
    for wrong, why in (
        (rotated, "rotation that differs by 11.5 degrees"),
        (Rigid3(GEOMETRY.rotation[1], np.array([0.0, 0.5, 0.0])), "another direction"),
    ):
        config = rig([GEOMETRY[0], wrong])
        found = with_rigs(model, assign_images(model.images.name, [config]), MapperConfig())
        assert found.scale is None and len(found.model.rigs) == len(model.rigs)
        assert any("cam1/" in note and why in note for note in found.notes)


def with_lengths(*factors: float) -> RigConfig:
    """The geometry with other distances from the reference."""
    given = [Rigid3(GEOMETRY.rotation[s], f * GEOMETRY.translation[s]) for s, f in enumerate(factors)]
    return rig(given)


def test_of_three_distances_one_that_contradicts_the_others_is_not_used():
    found, _ = rigged(0, with_lengths(1.0, 1.0, 2.0, 1.0))
    assert {*found.geometry} == {"cam0/", "cam1/", "cam3/"} and found.scale is not None
    (note,) = [note for note in found.notes if "cam2/" in note]
    assert "0.50 times the given distance" in note
    right, _ = rigged(0, rig([GEOMETRY[0], GEOMETRY[1], None, GEOMETRY[3]]))
    spans = [np.linalg.norm(np.ptp(one.model.camera_centers_in_world(), axis=0)) for one in (found, right)]
    assert spans[0] == pytest.approx(spans[1], rel=1e-3)
    assert not any("contradict the calibration" in note for note in found.notes)


def test_of_two_distances_that_contradict_each_other_none_is_used():
    found, _ = rigged(0, with_lengths(1.0, 1.0, 1.5))
    assert found.scale is None and found.geometry == {}
    assert sum("the given distance" in note for note in found.notes) == 2


def test_a_rig_in_centimeters_does_not_override_gps():
    """A model in meters stays as it is, and the note names both scales."""
    model, _ = mapped(0)
    metric = with_rigs(model, assign_images(model.images.name, [KNOWN]), MapperConfig()).model
    scale = np.linalg.norm(np.ptp(metric.camera_centers_in_world(), axis=0)) / np.linalg.norm(
        np.ptp(model.camera_centers_in_world(), axis=0)
    )
    in_meters = model.transformed(Similarity3(np.asarray(scale), np.eye(3), np.zeros(3)))
    gps = ScaleEstimate("GPS", "GPS", 1.0, 0.1, 0.0, "GPS of 48 images")
    assignment = assign_images(model.images.name, [with_lengths(1.0, 100.0, 100.0, 100.0)])
    found = with_rigs(in_meters, assignment, MapperConfig(), gps)
    assert found.model is in_meters and found.scale is None and found.geometry == {}
    expected = r"(99\.\d|100|101) times as large as by GPS of 48 images \(known to 10 %\)"
    assert any(re.search(expected, note) for note in found.notes)
    agreeing = with_rigs(in_meters, assign_images(model.images.name, [KNOWN]), MapperConfig(), gps)
    assert agreeing.scale is not None and len(agreeing.geometry) == 4


def test_cameras_that_move_are_no_rig():
    model, _ = mapped(0)
    names = list(model.images.name)
    order = np.random.default_rng(0).permutation(NUM_FRAMES)
    own = [names.index(f"cam1/{f:03d}.png") for f in range(NUM_FRAMES)]
    shuffled = np.arange(len(names))
    shuffled[own] = np.array(own)[order]
    mixed = replace(model, images=replace(model.images, name=tuple(names[k] for k in shuffled)))
    config = rig([Rigid3.identity(), None])
    found = with_rigs(mixed, assign_images(mixed.images.name, [config]), MapperConfig())
    assert any("varies" in note for note in found.notes) and found.geometry == {}


def test_images_are_assigned_by_the_longest_prefix():
    sensors = (
        RigSensor(NamePattern("a/"), Rigid3.identity(), None, ()),
        RigSensor(NamePattern("a/b"), None, None, ()),
    )
    config = RigConfig(sensors)
    found = assign_images(("a/1.png", "a/b1.png", "c/1.png", "a/2.png"), [config])
    assert found.sensor.tolist() == [0, 1, -1, 0] and found.frame.tolist() == [0, 0, -1, 1]
    with pytest.raises(ConfigError, match="no image name has the prefix 'a/b'"):
        assign_images(("a/1.png",), [config])


def test_images_are_assigned_by_wildcards(tmp_path):
    cameras = [{"image_pattern": "*_left.jpg", "ref_sensor": True}, {"image_pattern": "*_right.jpg"}]
    (tmp_path / "rig.json").write_text(json.dumps([{"cameras": cameras}]))
    rigs = read_rig_config(tmp_path / "rig.json")
    found = assign_images(("a/1_left.jpg", "a/1_right.jpg", "b/1_right.jpg", "b/1_left.jpg", "a/1.jpg"), rigs)
    assert found.sensor.tolist() == [0, 1, 1, 0, -1] and found.frame.tolist() == [0, 0, 1, 1, -1]
    with pytest.raises(ConfigError, match=r"no image name has the pattern '\*_right.jpg'"):
        assign_images(("1_left.jpg",), rigs)


@pytest.mark.parametrize(
    ("pattern", "name", "rest"),
    [
        ("IMG_*_?.jpg", "IMG_0012_L.jpg", ("", "0012", "L")),
        ("IMG_*_?.jpg", "day 1/IMG_0012_L.jpg", ("day 1/", "0012", "L")),
        ("*/cam0/*.png", "a/cam0/b.png", ("", "a", "b")),
        ("*.png", "a.jpg", None),
        ("a.?", "ab1", None),  # a dot is a dot
        ("*[1].png", "x[1].png", ("", "x")),
    ],
)
def test_what_wildcards_leave_open(pattern, name, rest):
    assert NamePattern(pattern, has_wildcards=True).rest_of(name) == rest


def write_pair_photographs(folder, rig_path, count=4, stated=0.3, meters_per_unit=None) -> None:
    """Photographs of a rendered pair with a baseline of 0.3 units, and its rig file, with intrinsics; with GPS if meters are given.

    stated: the baseline in the rig file.
    """
    right_from_left = Rigid3(np.eye(3), np.array([-0.3, 0.0, 0.0]))
    views = neighboring_views(count)
    origin = Georeference(46.5, 7.25, 500.0)
    for name, move in (("left", Rigid3.identity()), ("right", right_from_left)):
        (folder / name).mkdir(parents=True)
        for k in range(len(views)):
            image = render(courtyard(), CAMERA, move @ views[k], noise_sigma=1.5, seed=k)
            gps = None
            if meters_per_unit is not None:
                center = (move @ views[k]).centers()[None]
                lat_deg, lon_deg, alt_m = origin.lat_lon_alt_of(meters_per_unit * center)[0].tolist()
                gps = (lat_deg, lon_deg, alt_m)
            write_jpeg_with_exif(folder / name / f"{k}.jpg", image.rgb, focal_35mm=FOCAL_35MM, gps=gps)
    f, cx, cy, k1 = CAMERA.params.tolist()
    known = {"camera_model_name": "SIMPLE_RADIAL", "camera_params": [f, cx + 0.5, cy + 0.5, k1]}
    left = {"image_prefix": "left/", "ref_sensor": True, **known}
    pose = {"cam_from_rig_rotation": [1, 0, 0, 0], "cam_from_rig_translation": [-stated, 0, 0]}
    rig_path.write_text(json.dumps([{"cameras": [left, {"image_prefix": "right/", **pose, **known}]}]))


@pytest.mark.parametrize(("stated", "is_used"), [(600.0, False)] + IS_WHOLE * [(6.0, True)])
def test_photographs_with_gps_and_a_rig_file_in_meters_and_in_centimeters(tmp_path, stated, is_used):
    write_pair_photographs(tmp_path / "photographs", tmp_path / "rig.json", 5, stated, meters_per_unit=20.0)
    result = reconstruct(tmp_path / "photographs", tmp_path / "out", rigs=tmp_path / "rig.json")
    assert result.summary["is_metric"] and result.model.georeference is not None
    assert ("rigs" in result.summary["scale"]) == is_used and (len(result.model.frames) == 5) == is_used
    assert any("the rigs are not used" in warning for warning in result.warnings) != is_used
    centers, true = result.model.camera_centers_in_world(), neighboring_views(5).centers()
    left = [result.model.images.name.index(f"left/{k}.jpg") for k in range(5)]
    span, expected = np.linalg.norm(np.ptp(centers[left], axis=0)), np.linalg.norm(np.ptp(true, axis=0))
    assert span == pytest.approx(20.0 * expected, rel=0.05)


def test_photographs_of_a_pair_become_a_model_in_meters(tmp_path):
    write_pair_photographs(tmp_path / "photographs", tmp_path / "rig.json")
    result = reconstruct(tmp_path / "photographs", tmp_path / "out", rigs=tmp_path / "rig.json")
    assert result.summary["is_metric"] and "rigs" in result.summary["scale"]
    model = read_colmap_model(tmp_path / "out" / "sparse" / "0")
    assert model.is_registered().all() and len(model.frames) == 4
    row = {name: k for k, name in enumerate(model.images.name)}
    centers = model.camera_centers_in_world()
    true = neighboring_views(4).centers()
    for k in range(1, 4):
        length = np.linalg.norm(centers[row[f"left/{k}.jpg"]] - centers[row["left/0.jpg"]])
        assert abs(length / np.linalg.norm(true[k] - true[0]) - 1.0) < 0.01
    np.testing.assert_allclose(
        np.linalg.norm(centers[row["left/2.jpg"]] - centers[row["right/2.jpg"]]), 0.3, atol=1e-6
    )
    np.testing.assert_allclose(model.cameras.params[0, 0], CAMERA.params[0])  # given intrinsics stay


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "expected a list of rigs"),
        ([{}], "needs a list of cameras"),
        ([{"cameras": [{"image_prefix": "a/"}]}], "one camera with ref_sensor true, it has 0"),
        ([{"cameras": [{"ref_sensor": True}]}], "needs either an image_prefix"),
        (
            [{"cameras": [{"image_prefix": "a", "image_pattern": "a*", "ref_sensor": True}]}],
            "needs either an image_prefix",
        ),
        ([{"cameras": [{"image_pattern": "a", "ref_sensor": True}]}], "has no wildcard"),
        ([{"cameras": [{"image_prefix": "a", "ref_sensor": True, "shutter": 1}]}], "unknown key 'shutter'"),
        (
            [{"cameras": [{"image_prefix": "a", "ref_sensor": True}, {"image_prefix": "a"}]}],
            "'a' is given twice",
        ),
        (
            [
                {
                    "cameras": [
                        {"image_prefix": "a", "ref_sensor": True},
                        {"image_prefix": "b", "cam_from_rig_rotation": [1, 0, 0, 0]},
                    ]
                }
            ],
            "give both cam_from_rig_rotation and cam_from_rig_translation",
        ),
        (
            [
                {
                    "cameras": [
                        {"image_prefix": "a", "ref_sensor": True},
                        {
                            "image_prefix": "b",
                            "cam_from_rig_rotation": [2, 0, 0, 0],
                            "cam_from_rig_translation": [1, 0, 0],
                        },
                    ]
                }
            ],
            "unit quaternion",
        ),
        (
            [
                {
                    "cameras": [
                        {
                            "image_prefix": "a",
                            "ref_sensor": True,
                            "cam_from_rig_rotation": [1, 0, 0, 0],
                            "cam_from_rig_translation": [1, 0, 0],
                        }
                    ]
                }
            ],
            "must be the identity",
        ),
        (
            [{"cameras": [{"image_prefix": "a", "ref_sensor": True, "camera_model_name": "PINHOLE"}]}],
            "give both camera_model_name",
        ),
        (
            [
                {
                    "cameras": [
                        {
                            "image_prefix": "a",
                            "ref_sensor": True,
                            "camera_model_name": "PINHOLE",
                            "camera_params": [1, 2],
                        }
                    ]
                }
            ],
            "camera_params must be 4 numbers",
        ),
        (
            [
                {
                    "cameras": [
                        {
                            "image_prefix": "a",
                            "ref_sensor": True,
                            "camera_model_name": "X",
                            "camera_params": [1],
                        }
                    ]
                }
            ],
            "X",
        ),
    ],
)
def test_malformed_rig_files_are_named(tmp_path, content, message):
    (tmp_path / "rig.json").write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match=message):
        read_rig_config(tmp_path / "rig.json")
