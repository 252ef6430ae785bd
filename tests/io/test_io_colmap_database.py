"""COLMAP's database: round trips, half pixels, agreement with pycolmap, old versions, broken files."""

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pycolmap_process import needs_pycolmap, run_pycolmap

from epipole.errors import ConfigError, FileFormatError, ShapeError, WorkspaceError
from epipole.geometry import Rigid3, align_points, essential_from_cam2_from_cam1, fundamental_from_essential
from epipole.io import DatabaseContents, read_database, write_database
from epipole.robust.pairs.kind import PairKind
from epipole.scene import Reconstruction, ViewGraph
from io_models import mappable_model, small_model


def matches_of(model: Reconstruction, image1: int, image2: int) -> np.ndarray:
    """Keypoints of two images that see the same point."""
    point = model.point_of_keypoint()
    keypoint_of = []
    for image in (image1, image2):
        first, last = model.images.keypoint_offsets[image : image + 2]
        keypoint_of.append({int(p): k for k, p in enumerate(point[first:last]) if p >= 0})
    common = sorted(set(keypoint_of[0]) & set(keypoint_of[1]))
    return np.array([(keypoint_of[0][p], keypoint_of[1][p]) for p in common], np.int32).reshape(-1, 2)


def make_contents(model: Reconstruction, pairs: list[tuple[int, int]]) -> DatabaseContents:
    rng = np.random.default_rng(3)
    inliers = {pair: matches_of(model, *pair) for pair in pairs}
    clutter = np.array([[0, 1], [2, 3]], np.int32)
    putative = {pair: np.concatenate([clutter, m]).astype(np.int32) for pair, m in inliers.items()}
    motions, essentials, fundamentals = [], [], []
    cams_from_world = model.cams_from_world()
    for i, j in pairs:
        motion = cams_from_world[j] @ cams_from_world[i].inverse()
        motion = Rigid3(motion.rotation, motion.translation / np.linalg.norm(motion.translation))
        essential = essential_from_cam2_from_cam1(motion)
        K = [model.cameras[int(model.camera_of_image[image])].K for image in (i, j)]
        motions.append(motion)
        essentials.append(essential)
        fundamentals.append(fundamental_from_essential(essential, *K))
    homographies = rng.normal(size=(len(pairs), 3, 3)) + 3 * np.eye(3)
    homographies[0] = np.nan
    flat = np.concatenate(list(inliers.values()))
    graph = ViewGraph(
        image1=np.array([i for i, _ in pairs], np.int32),
        image2=np.array([j for _, j in pairs], np.int32),
        kind=np.array([PairKind.GENERAL] * len(pairs), np.int32),
        num_putative=np.array([len(m) for m in putative.values()], np.int32),
        match_offsets=np.concatenate([[0], np.cumsum([len(m) for m in inliers.values()])]).astype(np.int64),
        keypoint1=flat[:, 0].copy(),
        keypoint2=flat[:, 1].copy(),
        cam2_from_cam1=Rigid3(
            np.array([m.rotation for m in motions]), np.array([m.translation for m in motions])
        ),
        essential=np.array(essentials),
        fundamental=np.array(fundamentals),
        homography=homographies,
        median_angle_rad=np.full(len(pairs), np.nan),
    )
    number = np.diff(model.images.keypoint_offsets)
    descriptors = [rng.integers(0, 256, (n, 128)).astype(np.uint8) for n in number]
    gps = np.full((len(model.images), 3), np.nan)
    gps[1], gps[4] = [46.5, 7.25, 512.0], [46.6, 7.5, 530.0]
    trusted = np.arange(len(model.cameras)) != 1
    cameras = replace(model.cameras, is_focal_trusted=trusted)
    return DatabaseContents(
        cameras, model.rigs, model.frames, model.images, descriptors, putative, graph, gps
    )


PAIRS = [(0, 2), (0, 4), (1, 3), (2, 6)]


@pytest.fixture
def database(tmp_path: Path) -> Path:
    write_database(tmp_path / "database.db", make_contents(small_model(), PAIRS))
    return tmp_path / "database.db"


def test_round_trip(database: Path) -> None:
    wrote, read = make_contents(small_model(), PAIRS), read_database(database)
    np.testing.assert_array_equal(read.cameras.model, wrote.cameras.model)
    np.testing.assert_allclose(read.cameras.params, wrote.cameras.params, atol=1e-12)
    np.testing.assert_array_equal(read.cameras.is_focal_trusted, [True, False, True])
    np.testing.assert_array_equal(read.rigs.sensor_offsets, wrote.rigs.sensor_offsets)
    np.testing.assert_allclose(
        read.rigs.cam_from_rig.as_matrix(), wrote.rigs.cam_from_rig.as_matrix(), atol=1e-14
    )
    np.testing.assert_array_equal(read.frames.rig, wrote.frames.rig)
    assert not read.frames.is_registered().any()
    assert read.images.name == wrote.images.name
    np.testing.assert_array_equal(read.images.frame, wrote.images.frame)
    np.testing.assert_array_equal(read.images.sensor, wrote.images.sensor)
    np.testing.assert_array_equal(read.images.keypoint_offsets, wrote.images.keypoint_offsets)
    # Keypoints are stored in single precision: 2^-24 of 800 pixels.
    np.testing.assert_allclose(read.images.keypoints_px, wrote.images.keypoints_px, atol=5e-5)
    assert read.descriptors is not None and wrote.descriptors is not None
    for mine, theirs in zip(read.descriptors, wrote.descriptors):
        np.testing.assert_array_equal(mine, theirs)
    assert list(read.matches) == list(wrote.matches)
    for pair, rows in wrote.matches.items():
        np.testing.assert_array_equal(read.matches[pair], rows)
        assert read.matches[pair].dtype == np.int32
    np.testing.assert_array_equal(read.gps_lat_lon_alt, wrote.gps_lat_lon_alt)
    mine, graph = read.view_graph, wrote.view_graph
    assert mine is not None and graph is not None
    for name in ("image1", "image2", "kind", "num_putative", "match_offsets", "keypoint1", "keypoint2"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(graph, name), err_msg=name)
    for name in ("essential", "fundamental", "homography"):
        np.testing.assert_allclose(getattr(mine, name), getattr(graph, name), atol=1e-12, err_msg=name)
    np.testing.assert_allclose(mine.cam2_from_cam1.as_matrix(), graph.cam2_from_cam1.as_matrix(), atol=1e-14)


def test_half_pixel(database: Path) -> None:
    """In the file x' = x + 1/2; the stored F and H hold for the stored keypoints."""
    contents = make_contents(small_model(), PAIRS)
    graph, images = contents.view_graph, contents.images
    assert graph is not None
    with closing(sqlite3.connect(database)) as connection:
        data, params = (
            connection.execute(query).fetchone()[0]
            for query in (
                "SELECT data FROM keypoints WHERE image_id = 1",
                "SELECT params FROM cameras WHERE camera_id = 1",
            )
        )
        F, H, pair_id = connection.execute(
            "SELECT F, H, pair_id FROM two_view_geometries LIMIT 1 OFFSET 1"
        ).fetchone()
    np.testing.assert_allclose(
        np.frombuffer(data, "<f4").reshape(-1, 2), images.keypoints_of(0) + 0.5, atol=5e-5
    )
    assert np.frombuffer(params)[1:3].tolist() == [310.5, 245.5]
    assert pair_id == 2147483647 * 1 + 5
    x1 = np.array([120.0, 77.0, 1.0])
    moved = np.array([0.5, 0.5, 0.0])
    line = graph.fundamental[1] @ x1
    x2 = np.array([10.0, -(line[0] * 10.0 + line[2]) / line[1], 1.0])  # on the line of x1
    assert abs((x2 + moved) @ np.frombuffer(F).reshape(3, 3) @ (x1 + moved)) < 1e-9 * np.abs(line).max()
    y = graph.homography[1] @ x1
    y_file = np.frombuffer(H).reshape(3, 3) @ (x1 + moved)
    np.testing.assert_allclose(y_file / y_file[2], y / y[2] + moved, rtol=1e-12)


def test_a_pair_in_the_other_direction_is_turned(tmp_path: Path) -> None:
    model = small_model()
    rotated = make_contents(model, [(2, 0), (4, 0), (3, 1), (6, 2)])
    write_database(tmp_path / "turned.db", rotated)
    write_database(tmp_path / "plain.db", make_contents(model, PAIRS))
    mine, plain = read_database(tmp_path / "turned.db"), read_database(tmp_path / "plain.db")
    a, b, given = mine.view_graph, plain.view_graph, rotated.view_graph
    assert a is not None and b is not None and given is not None
    np.testing.assert_array_equal(a.image1, b.image1)
    np.testing.assert_array_equal(a.keypoint1, b.keypoint1)
    np.testing.assert_array_equal(a.keypoint2, b.keypoint2)
    np.testing.assert_allclose(a.cam2_from_cam1.as_matrix(), b.cam2_from_cam1.as_matrix(), atol=1e-12)
    for name in ("essential", "fundamental"):
        x, y = (
            m / np.linalg.norm(m, axis=(1, 2), keepdims=True) for m in (getattr(a, name), getattr(b, name))
        )
        np.testing.assert_allclose(np.abs((x * y).sum(axis=(1, 2))), 1, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(a.homography[1] @ given.homography[1], np.eye(3), atol=1e-9)
    np.testing.assert_array_equal(mine.matches[0, 2][2:], plain.matches[0, 2][2:])


def test_the_same_contents_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.db", "b.db"):
        write_database(tmp_path / name, make_contents(small_model(), PAIRS))
    assert (tmp_path / "a.db").read_bytes() == (tmp_path / "b.db").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.db", "b.db"]


def test_kinds(tmp_path: Path) -> None:
    contents = make_contents(small_model(), [(0, 1), (0, 2), (0, 3), (0, 4), (0, 5), (0, 6)])
    assert contents.view_graph is not None
    kinds = np.array(sorted(PairKind), np.int32)
    graph = replace(contents.view_graph, kind=kinds)
    graph.cam2_from_cam1.translation[0] = np.nan
    write_database(tmp_path / "x.db", replace(contents, view_graph=graph))
    read = read_database(tmp_path / "x.db").view_graph
    assert read is not None
    # COLMAP has no name for two images without motion: they come back as a rotation.
    np.testing.assert_array_equal(read.kind, [*kinds[:-1], PairKind.ROTATION])
    assert np.isnan(read.cam2_from_cam1.translation[0]).all()
    assert np.isfinite(read.cam2_from_cam1.translation[1:]).all()


def test_without_anything_optional(tmp_path: Path) -> None:
    model = small_model()
    write_database(tmp_path / "x.db", DatabaseContents(model.cameras, model.rigs, model.frames, model.images))
    read = read_database(tmp_path / "x.db")
    assert read.descriptors is None and read.view_graph is None and read.gps_lat_lon_alt is None
    assert read.matches == {}


def test_misuse_is_refused(tmp_path: Path) -> None:
    good = make_contents(small_model(), PAIRS)
    graph = good.view_graph
    assert graph is not None and good.descriptors is not None
    names = ("b1.jpg", *good.images.name[1:])
    twice = replace(graph, image1=graph.image1[[0, 0, 2, 3]], image2=graph.image2[[0, 0, 2, 3]])
    wrong_rows = [good.descriptors[0][:3], *good.descriptors[1:]]
    far = np.array([[0, 10**6]], np.int32)
    cases = [
        (ConfigError, "same name", replace(good, images=replace(good.images, name=names))),
        (ShapeError, "view graph contains a pair twice", replace(good, view_graph=twice)),
        (ShapeError, "descriptors of", replace(good, descriptors=wrong_rows)),
        (ShapeError, "9 images have 1", replace(good, descriptors=good.descriptors[:1])),
        (ShapeError, "refer to missing keypoints", replace(good, matches={(0, 1): far})),
        (ShapeError, "not a pair of images", replace(good, matches={(0, 77): far})),
        (ShapeError, "both directions", replace(good, matches={(0, 1): far[:0], (1, 0): far[:0]})),
        (ShapeError, "lengths differ", replace(good, gps_lat_lon_alt=np.zeros((2, 3)))),
    ]
    for error, message, contents in cases:
        with pytest.raises(error, match=message):
            write_database(tmp_path / "x.db", contents)
    (tmp_path / "file").write_text("")
    with pytest.raises(WorkspaceError):
        write_database(tmp_path / "file" / "x.db", good)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_an_older_database_is_replaced_with_its_side_files(database: Path) -> None:
    for suffix in ("-wal", "-shm", "-journal"):
        database.with_name(database.name + suffix).write_bytes(b"stale")
    write_database(database, make_contents(small_model(1), PAIRS))
    assert [p.name for p in database.parent.iterdir()] == ["database.db"]
    assert len(read_database(database).images) == 9


def test_databases_without_rigs_frames_types_and_poses(database: Path) -> None:
    """As COLMAP 3 wrote them."""
    with closing(sqlite3.connect(database)) as connection, connection:
        for table in (
            "rigs",
            "rig_sensors",
            "frames",
            "frame_data",
            "pose_priors",
            "descriptors",
            "two_view_geometries",
        ):
            connection.execute(f"DROP TABLE {table}")
        connection.execute("CREATE TABLE descriptors (image_id, rows, cols, data)")
        connection.execute("INSERT INTO descriptors VALUES (1, 19, 128, ?)", (bytes(19 * 128),))
        connection.execute("CREATE TABLE two_view_geometries (pair_id, rows, cols, data, config, F, E, H)")
        zeros = np.zeros(9).tobytes()
        row = (2147483647 + 3, 0, 0, None, 1, zeros, b"", None)
        connection.execute("INSERT INTO two_view_geometries VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)
        connection.execute(
            "CREATE TABLE pose_priors (image_id, position BLOB, coordinate_system, position_covariance)"
        )
        position = np.array([1.0, 2.0, 3.0]).tobytes()
        connection.execute(
            "INSERT INTO pose_priors VALUES (3, ?, 0, NULL), (4, ?, 1, NULL)", (position, position)
        )
    read = read_database(database)
    assert len(read.rigs) == 3 and len(read.frames) == 9
    assert read.descriptors is not None and read.descriptors[0] is not None and read.descriptors[1] is None
    graph = read.view_graph
    assert graph is not None and graph.kind.tolist() == [PairKind.DEGENERATE]
    assert np.isnan(graph.fundamental).all() and np.isnan(graph.cam2_from_cam1.translation).all()
    assert read.gps_lat_lon_alt is not None
    assert np.flatnonzero(np.isfinite(read.gps_lat_lon_alt[:, 0])).tolist() == [2]


@pytest.mark.parametrize("columns", [4, 6])
def test_keypoints_with_more_columns(database: Path, columns: int) -> None:
    keypoints = np.arange(5.0 * columns).reshape(5, columns).astype("<f4")
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.execute(
            "UPDATE keypoints SET rows = 5, cols = ?, data = ? WHERE image_id = 9",
            (columns, keypoints.tobytes()),
        )
        connection.execute("DELETE FROM descriptors")
    np.testing.assert_array_equal(read_database(database).images.keypoints_of(8), keypoints[:, :2] - 0.5)


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        (
            "UPDATE keypoints SET rows = rows + 1 WHERE image_id = 2",
            "keypoints of image 2: 20 x 2 values do not",
        ),
        ("UPDATE keypoints SET rows = 1000000000000 WHERE image_id = 2", "keypoints of image 2"),
        ("UPDATE keypoints SET rows = -1 WHERE image_id = 2", "impossible size"),
        ("UPDATE keypoints SET cols = 'x' WHERE image_id = 2", "impossible size"),
        ("UPDATE descriptors SET cols = 64 WHERE image_id = 2", "descriptors of image 2"),
        (
            "UPDATE matches SET pair_id = 77 WHERE pair_id = 2147483650",
            "pair 77: images 0 and 77 are not defined",
        ),
        ("UPDATE matches SET rows = rows + 1", "pair 2147483650: .* x 2 values do not take"),
        ("UPDATE matches SET data = zeroblob(4), rows = 1, cols = 1", "1 columns, expected 2"),
        ("UPDATE two_view_geometries SET config = 99", "unknown configuration 99"),
        ("UPDATE two_view_geometries SET F = zeroblob(8)", "1 x 9 values do not take 8 bytes"),
        ("UPDATE cameras SET params = zeroblob(8)", "camera 1: camera model 2 has 4 parameters"),
        ("UPDATE cameras SET model = 99", "camera 1: unknown camera model 99"),
        ("DELETE FROM cameras WHERE camera_id = 3", "camera 3 is not defined"),
        ("DELETE FROM frame_data WHERE data_id = 4", "image 4 belongs to no frame"),
        ("DELETE FROM rigs WHERE rig_id = 2", "rig 2 is not defined"),
        ("UPDATE rig_sensors SET sensor_from_rig = zeroblob(56)", "not a unit quaternion"),
        ("DROP TABLE keypoints", "not a COLMAP database"),
        ("ALTER TABLE two_view_geometries RENAME COLUMN config TO configuration", "not a readable database"),
    ],
)
def test_broken_contents_are_refused(database: Path, statement: str, message: str) -> None:
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.execute(statement)
    with pytest.raises(FileFormatError, match=message):
        read_database(database)


def test_what_is_no_database(tmp_path: Path, database: Path) -> None:
    with pytest.raises(FileFormatError, match="it does not exist"):
        read_database(tmp_path / "none.db")
    (tmp_path / "text.db").write_text("not a database " * 100)
    with pytest.raises(FileFormatError, match="not a readable database"):
        read_database(tmp_path / "text.db")
    (tmp_path / "empty.db").write_bytes(b"")
    with pytest.raises(FileFormatError, match="not a COLMAP database"):
        read_database(tmp_path / "empty.db")
    whole = database.read_bytes()
    for length in (50, 1000, len(whole) // 2, len(whole) - 5000):
        database.write_bytes(whole[:length])
        with pytest.raises(FileFormatError):
            read_database(database)


@needs_pycolmap
def test_the_schema_is_that_of_pycolmap(tmp_path: Path, database: Path) -> None:
    run_pycolmap("pycolmap.Database.open(args[0]).close(); print('null')", tmp_path / "theirs.db")
    schemas = []
    for path in (tmp_path / "theirs.db", database):
        with closing(sqlite3.connect(path)) as connection:
            names = [
                row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
            ]
            indices = connection.execute(
                "SELECT name, tbl_name FROM sqlite_master WHERE type = 'index'"
            ).fetchall()
            columns = {name: connection.execute(f"PRAGMA table_info({name})").fetchall() for name in names}
            version = connection.execute("PRAGMA user_version").fetchone()
        schemas.append((columns, sorted(indices), version))
    assert schemas[0] == schemas[1]


@needs_pycolmap
def test_pycolmap_reads_what_we_write(database: Path) -> None:
    script = """
    db = pycolmap.Database.open(args[0])
    pair = db.read_two_view_geometry(1, 5)
    motion = pair.cam2_from_cam1
    print(json.dumps({
        "counts": [db.num_cameras(), db.num_rigs(), db.num_frames(), db.num_images(), db.num_keypoints(),
                   db.num_descriptors(), db.num_matched_image_pairs(), db.num_verified_image_pairs()],
        "prior": [bool(db.read_camera(i).has_prior_focal_length) for i in (1, 2, 3)],
        "names": [image.name for image in db.read_all_images()],
        "keypoints": np.asarray(db.read_keypoints(1)[:, :2] if hasattr(db.read_keypoints(1), "shape")
                                else [[k.x, k.y] for k in db.read_keypoints(1)]).tolist(),
        "matches": np.asarray(db.read_matches(1, 5)).tolist(),
        "inliers": np.asarray(pair.inlier_matches).tolist(), "config": int(pair.config),
        "E": pair.E.tolist(), "F": pair.F.tolist(), "motion": motion.matrix().tolist(),
        "gps": sorted([p.corr_data_id.id, p.position.tolist(), p.coordinate_system.name]
                      for p in db.read_all_pose_priors()),
        "rig": [[s.id for s in rig.sensor_ids()] for rig in db.read_all_rigs()],
    }))
    """
    contents = make_contents(small_model(), PAIRS)
    graph = contents.view_graph
    assert graph is not None
    theirs = run_pycolmap(script, database)
    assert theirs["counts"] == [
        3,
        2,
        6,
        9,
        len(contents.images.keypoints_px),
        len(contents.images.keypoints_px),
        4,
        4,
    ]
    assert theirs["prior"] == [True, False, True]
    assert theirs["names"] == list(contents.images.name)
    np.testing.assert_allclose(theirs["keypoints"], contents.images.keypoints_of(0) + 0.5, atol=5e-5)
    np.testing.assert_array_equal(theirs["matches"], contents.matches[0, 4])
    np.testing.assert_array_equal(theirs["inliers"], contents.matches[0, 4][2:])
    assert theirs["config"] == 2
    np.testing.assert_allclose(theirs["E"], graph.essential[1], atol=1e-14)
    np.testing.assert_allclose(theirs["motion"], graph.cam2_from_cam1[1].as_matrix()[:3], atol=1e-12)
    # COLMAP's F from its own calibration matrices, half a pixel further.
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    K = [half @ contents.cameras[c].K for c in (0, 0)]
    expected = np.linalg.inv(K[1]).T @ graph.essential[1] @ np.linalg.inv(K[0])
    np.testing.assert_allclose(theirs["F"], expected, atol=1e-12)
    assert theirs["gps"] == [[2, [46.5, 7.25, 512.0], "WGS84"], [5, [46.6, 7.5, 530.0], "WGS84"]]
    assert theirs["rig"] == [[1, 2], [3]]


@needs_pycolmap
def test_we_read_what_pycolmap_writes(tmp_path: Path) -> None:
    script = """
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 2, 2
    options.num_frames_per_rig, options.num_points3D = 2, 30
    options.prior_position = True
    options.two_view_geometry_has_relative_pose = True
    db = pycolmap.Database.open(args[0])
    model = pycolmap.synthesize_dataset(options, db)
    db.close()
    model.write_binary(args[1])
    print(json.dumps({i: model.images[i].cam_from_world().matrix().tolist() for i in model.images}))
    """
    (tmp_path / "model").mkdir()
    poses = run_pycolmap(script, tmp_path / "database.db", tmp_path / "model")
    before = sorted(p.name for p in tmp_path.iterdir())
    read = read_database(tmp_path / "database.db")
    assert sorted(p.name for p in tmp_path.iterdir()) == before
    assert len(read.images) == 8 and len(read.rigs) == 2 and len(read.frames) == 4
    graph = read.view_graph
    assert graph is not None and len(graph) == len(read.matches) > 5
    assert read.descriptors is not None and all(d is not None and d.shape[1] == 128 for d in read.descriptors)
    num_tested = 0
    for e in range(len(graph)):
        i, j = int(graph.image1[e]), int(graph.image2[e])
        rows = slice(int(graph.match_offsets[e]), int(graph.match_offsets[e + 1]))
        x1 = read.images.keypoints_of(i)[graph.keypoint1[rows]]
        x2 = read.images.keypoints_of(j)[graph.keypoint2[rows]]
        c1, c2 = (read.cameras[int(read.rigs.sensor_camera[read.images.sensor[k]])] for k in (i, j))
        # E holds for undistorted rays: the pixels, the half pixel and the matrices fit together.
        residual = (c2.unproject(x2) * (c1.unproject(x1) @ graph.essential[e].T)).sum(axis=1)
        assert np.abs(residual).max() < 1e-5
        P1, P2 = (np.array([*poses[str(k + 1)], [0, 0, 0, 1]]) for k in (i, j))
        motion = P2 @ np.linalg.inv(P1)
        if np.isfinite(graph.cam2_from_cam1.translation[e]).all():
            t = motion[:3, 3] / np.linalg.norm(motion[:3, 3])
            np.testing.assert_allclose(graph.cam2_from_cam1.rotation[e], motion[:3, :3], atol=1e-9)
            np.testing.assert_allclose(graph.cam2_from_cam1.translation[e], t, atol=1e-9)
            num_tested += 1
    assert num_tested > 5


@needs_pycolmap
def test_pycolmap_maps_from_our_database(tmp_path: Path) -> None:
    """The incremental mapper gets from our matches to our cameras."""
    model = mappable_model()
    n = len(model.images)
    write_database(
        tmp_path / "database.db", make_contents(model, [(i, j) for i in range(n) for j in range(i + 1, n)])
    )
    (tmp_path / "images").mkdir()
    script = """
    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    options.num_threads = 1
    models = pycolmap.incremental_mapping(args[0], args[1], args[2], options)
    best = max(models.values(), key=lambda m: m.num_reg_images())
    print(json.dumps({"error": best.compute_mean_reprojection_error(), "points": best.num_points3D(),
                      "centers": {im.name: im.projection_center().tolist() for im in best.images.values()}}))
    """
    theirs = run_pycolmap(script, tmp_path / "database.db", tmp_path / "images", tmp_path / "sparse")
    assert sorted(theirs["centers"]) == sorted(model.images.name)
    assert theirs["points"] > 100 and theirs["error"] < 0.5
    mine = model.camera_centers_in_world()
    centers = np.array([theirs["centers"][name] for name in model.images.name])
    assert np.abs(align_points(centers, mine).apply(centers) - mine).max() < 0.02
