"""RealityScan's camera parameters as CSV: the published formula and example, there and back, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, FileFormatError
from epipole.io import read_model, read_realityscan, write_realityscan
from epipole.io.images.writing import write_jpeg_with_exif
from epipole.scene import Cameras, Reconstruction
from io_models import mappable_model, small_model

HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
ROW = (
    "frame_00001.jpeg,44.5876747664166,138.823621534044,6.821916401534405,170.3483067926429,85.18637269312288,"
    "-22.74995074830745,14.2390682243052,-9.482184385774318e-004,-2.446553068050568e-004,3.114799768048152e-003,"
    "4.026391718074555e-003,-1.795976992379612e-003,0,0,0"
)
"""The first camera of a sample that is published with Postshot; its images have 3840 x 2880 pixels."""
EXAMPLE = f"{HEADER}\n{ROW}\nb.png,1,2,3,0,0,0,18,0,0,0,0,0,0,0.01,-0.02\n"


def written(folder: Path, text: str = EXAMPLE, sizes: tuple = ((3840, 2880), (80, 60))) -> Path:
    (folder / "images").mkdir(exist_ok=True)
    for name, size in zip(("frame_00001.jpeg", "b.png"), sizes):
        Image.new("L", size).save(folder / "images" / name)
    (folder / "cameras.csv").write_text(text, encoding="utf-8")
    return folder / "cameras.csv"


def published_rotation(heading_deg: float, pitch_deg: float, roll_deg: float) -> np.ndarray:
    """The function `EulerRotation` of Capturing Reality's article on registration exports: world to camera, by rows."""
    y, p, r = np.deg2rad([heading_deg, pitch_deg, roll_deg])
    cx, cy, cz, sx, sy, sz = np.cos(r), np.cos(p), np.cos(y), np.sin(r), np.sin(p), np.sin(y)
    return np.array(
        [
            [cx * cz + sx * sy * sz, -cx * sz + cz * sx * sy, -cy * sx],
            [-cy * sz, -cy * cz, -sy],
            [cx * sy * sz - cz * sx, cx * cz * sy + sx * sz, -cx * cy],
        ]
    )


def test_the_angles_are_those_of_an_aircraft(tmp_path: Path) -> None:
    """Hornacek 2026, section 5.1: yaw, pitch and roll in ZYX order rotate an aircraft's axes (nose, right wing, down) relative to
    north, east, down; the camera's x (right) is the right wing, its y (up in the image) the nose, and it looks down.
    """
    rng = np.random.default_rng(3)
    angles = rng.uniform([-180, -80, -180], [180, 80, 180], (20, 3))
    rows = "".join(
        f"{n}.png,0,{n},0,{y!r},{p!r},{r!r},18,0,0,0,0,0,0,0,0\n"
        for n, (y, p, r) in enumerate(angles.tolist())
    )
    for n in range(20):
        Image.new("L", (8, 6)).save(tmp_path / f"{n}.png")
    (tmp_path / "a.csv").write_text(f"{HEADER}\n{rows}")
    found = read_realityscan(tmp_path / "a.csv").cams_from_world().rotation
    ned_from_body = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    enu_from_ned = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    nose, wing, down = (enu_from_ned @ ned_from_body[:, :, k, None] for k in range(3))
    np.testing.assert_allclose(
        found, np.stack([wing[..., 0], -nose[..., 0], down[..., 0]], axis=1), atol=1e-14
    )


def test_a_published_example(tmp_path: Path) -> None:
    model = read_realityscan(written(tmp_path))
    assert model.images.name == ("frame_00001.jpeg", "b.png")
    np.testing.assert_allclose(
        model.cams_from_world().rotation[0],
        published_rotation(170.3483067926429, 85.18637269312288, -22.74995074830745),
        atol=1e-14,
    )
    centers = [[44.5876747664166, 138.823621534044, 6.821916401534405], [1, 2, 3]]
    np.testing.assert_allclose(model.camera_centers_in_world(), centers, atol=1e-12)
    # Angles of zero: the camera looks down, and the top of its image points along +y.
    np.testing.assert_allclose(model.cams_from_world().rotation[1], np.diag([1, -1, -1]), atol=1e-15)
    camera = model.cameras[0]
    assert camera.model == CameraModel.FULL_OPENCV and (camera.width, camera.height) == (3840, 2880)
    focal = 14.2390682243052 * 3840 / 36
    center = [1919.5 - 9.482184385774318e-4 * 3840, 1439.5 - 2.446553068050568e-4 * 3840]
    np.testing.assert_allclose(camera.params[:4], [focal, focal, *center])
    coefficients = [3.114799768048152e-3, 4.026391718074555e-3, 0, 0, -1.795976992379612e-3, 0, 0, 0]
    np.testing.assert_array_equal(camera.params[4:], coefficients)


def test_the_projection_is_browns(tmp_path: Path) -> None:
    """Hornacek 2026, equations 47 and 48: t1 belongs to r^2 + 2 x^2."""
    model = read_realityscan(written(tmp_path))
    x, y, t1, t2 = 0.3, -0.2, 0.01, -0.02
    r2 = x * x + y * y
    u = 40 + 80 * 18 / 36 * (x + t1 * (r2 + 2 * x * x) + 2 * t2 * x * y)
    v = 30 + 80 * 18 / 36 * (y + t2 * (r2 + 2 * y * y) + 2 * t1 * x * y)
    found = model.cameras[1].project(np.array([[x, y, 1.0]]))[0]
    np.testing.assert_allclose(found + 0.5, [u, v], atol=1e-12)


def test_the_longer_side_is_36_mm(tmp_path: Path) -> None:
    text = f"{HEADER}\nb.png,1,2,3,0,0,0,18,0.1,-0.1,0,0,0,0,0,0\n"
    camera = read_realityscan(written(tmp_path, text, ((8, 8), (60, 80)))).cameras[0]
    assert camera.model == CameraModel.PINHOLE and (camera.width, camera.height) == (60, 80)
    np.testing.assert_allclose(camera.params, [40, 40, 29.5 + 8, 39.5 - 8])


@pytest.mark.parametrize(
    "header",
    [
        "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2",
        f"#cameras 2\n{HEADER}",
        f"\ufeff{HEADER.upper()}",
    ],
)
def test_other_headers_of_the_same_columns(tmp_path: Path, header: str) -> None:
    expected = read_realityscan(written(tmp_path))
    found = read_model(written(tmp_path, EXAMPLE.replace(HEADER, header)))
    np.testing.assert_array_equal(found.cams_from_world().as_matrix(), expected.cams_from_world().as_matrix())
    np.testing.assert_array_equal(found.cameras.params, expected.cameras.params)


@pytest.mark.parametrize("altitude", ["alt", "z"])
def test_poses_without_intrinsics_use_exif(tmp_path: Path, altitude: str) -> None:
    path = written(tmp_path, f"#name,x,y,{altitude},heading,pitch,roll\na.jpg,1,2,3,10,80,5\n")
    with pytest.raises(FileFormatError, match=r"an image cannot be read.*a\.jpg"):
        read_realityscan(path)
    Image.new("L", (40, 30)).save(tmp_path / "a.jpg")
    with pytest.raises(FileFormatError, match=r"the focal length of 'a.jpg' is unknown"):
        read_realityscan(path)
    write_jpeg_with_exif(tmp_path / "a.jpg", np.zeros((30, 40, 3), np.uint8), focal_35mm=27)
    with pytest.warns(RuntimeWarning, match="it has no intrinsics; focal lengths are those of EXIF"):
        model = read_realityscan(path)
    np.testing.assert_allclose(model.cams_from_world().rotation[0], published_rotation(10, 80, 5), atol=1e-14)
    np.testing.assert_allclose(model.cameras[0].params, [30, 30, 19.5, 14.5])


def representable(model: Reconstruction) -> Reconstruction:
    """With one focal length for each camera, which the format has."""
    cameras = []
    for camera in model.cameras:
        params = camera.params.copy()
        params[list(camera.model.focal_indices)] = camera.focal_px
        cameras.append(Camera(camera.model, camera.width, camera.height, params))
    return replace(model, cameras=Cameras.from_list(cameras))


@pytest.mark.parametrize("model", [small_model(), mappable_model()])
def test_there_and_back(tmp_path: Path, model: Reconstruction) -> None:
    model = representable(model)
    known = np.flatnonzero(model.is_registered())
    for row, name in enumerate(model.images.name):
        camera = model.cameras[int(model.camera_of_image[row])]
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (camera.width, camera.height)).save(tmp_path / "images" / name)
    write_realityscan(model, tmp_path / "cameras.csv")
    found = read_model(tmp_path)
    assert found.images.name == tuple(model.images.name[k] for k in known)
    matrices = model.cams_from_world().as_matrix()[known]
    np.testing.assert_allclose(found.cams_from_world().as_matrix(), matrices, rtol=0, atol=1e-12)
    points = model.points.xyz_in_world + np.array([0.0, 0.0, 5.0])
    for image, row in enumerate(known):
        one, other = (
            each.cameras[int(each.camera_of_image[k])] for each, k in ((found, image), (model, row))
        )
        assert (one.width, one.height) == (other.width, other.height)
        np.testing.assert_allclose(one.project(points), other.project(points), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("k4,t1,t2", "k4,t1,omega", "unknown column 'omega'; known are name, x"),
        ("k4,t1,t2", "k4,t1,t1", "two columns are t1"),
        ("heading,", "heading,yaw,", "two columns are heading"),
        ("k4,t1,t2", "k4,t1", "it has no column t2"),
        ("alt,", "", "it has no column alt"),
        (",f,px,py", "", "it has distortion, but no column f"),
        ("f,px,py", "f,px", "it has no column py"),
        ("b.png,1,2,3", "b.png,1,2", "line 3: 16 values expected, got 15"),
        ("b.png,1,2,3", "b.png,1,2,nan", "line 3: alt is not a finite number, got 'nan'"),
        ("b.png,1,2,3", "b.png,1,two,3", "line 3: y is not a finite number, got 'two'"),
        ("b.png,1,2,3", "b.png,1,2,1e300", "a number that is too large"),
        ("0,0,0,18,", "0,0,0,-18,", "the camera of 'b.png': the focal length must be positive"),
        ("0,0,0,0,0.01,", "0,0,0,0.5,0.01,", "k4 = 0.5 of 'b.png' is not supported: align with Brown3"),
        ("b.png", "frame_00001.jpeg", "two cameras with the name 'frame_00001.jpeg'"),
        ("b.png", "../b.png", "does not name a file inside this folder"),
        ("b.png", "c.png", "it has no image sizes, and an image cannot be read"),
        ("b.png", "", "line 3: a name is empty"),
        (EXAMPLE, f"{HEADER}\n", "it has no cameras"),
        (EXAMPLE, "", "not cameras of RealityScan"),
        (EXAMPLE, ROW, "not cameras of RealityScan"),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in EXAMPLE
    with pytest.raises(FileFormatError, match=words):
        read_realityscan(written(tmp_path, EXAMPLE.replace(old, new)))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            EXAMPLE.replace(",k1,k2,k3,k4,t1,t2", "")
            .replace(ROW + "\n", "")
            .replace(",0,0,0,0,0.01,-0.02", ""),
            "no columns",
        ),
        (f"{HEADER}\nb.png,1,2,3,0,0,0,18,0,0,-0.2,0,0,0,0,0\n", "only k1 is not zero"),
        (
            f"{HEADER}\nb.png,-34.828,7.1633,86,0,0,0,18,0,0,0,0,0,0,0,0\n"
            "frame_00001.jpeg,-34.829,7.1631,87,0,0,0,18,0,0,0,0,0,0,0,0\n",
            "x and y may be degrees of longitude and latitude",
        ),
        (
            f"{HEADER}\nb.png,691000.5,5335000.25,86,0,0,0,18,0,0,0,0,0,0,0,0\n",
            "x and y may be coordinates of a map projection",
        ),
    ],
)
def test_what_the_file_leaves_open_is_said(tmp_path: Path, text: str, words: str) -> None:
    with pytest.warns(RuntimeWarning, match=words):
        read_realityscan(written(tmp_path, text))


def test_what_the_format_cannot_store_is_refused(tmp_path: Path) -> None:
    model = mappable_model()
    for params, words in (
        (np.array([500.0, 500.0, 320.0, 240.0, 0, 0, 0, 0, 0, 0.1, 0, 0]), "no rational camera model"),
        (np.array([500.0, 600.0, 320.0, 240.0]), "RealityScan has a single focal length, but"),
        (np.array([500.0, 500.0, 320.0, 240.0, 0.1, 0, 0, 0]), "no fisheye camera model"),
    ):
        kind = {12: CameraModel.FULL_OPENCV, 4: CameraModel.PINHOLE, 8: CameraModel.OPENCV_FISHEYE}
        cameras = Cameras.from_list([Camera(kind[len(params)], 640, 480, params)])
        with pytest.raises(ConfigError, match=words):
            write_realityscan(replace(model, cameras=cameras), tmp_path / "c.csv")
    for name in ("a,b.jpg", '"a".jpg', "#a.jpg", " a.jpg"):
        images = replace(model.images, name=(name, *model.images.name[1:]))
        with pytest.raises(ConfigError, match="cannot be written to a CSV file of RealityScan"):
            write_realityscan(replace(model, images=images), tmp_path / "c.csv")
    assert not list(tmp_path.iterdir())
