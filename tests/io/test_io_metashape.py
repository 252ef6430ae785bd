"""Metashape's cameras as XML: there and back, in the form that Metashape writes, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry.geodesy import lat_lon_alt_from_ecef
from epipole.io import read_metashape, read_model, write_metashape
from epipole.scene import Cameras, Georeference, Reconstruction
from io_models import mappable_model, small_model

SENSOR = """
      <sensor id="0" label="M3M (12.29mm)" type="frame">
        <resolution width="5280" height="3956"/>
        <property name="pixel_width" value="0.00335820"/>
        <property name="focal_length" value="12.28999999"/>
        <calibration type="frame" class="initial">
          <resolution width="5280" height="3956"/>
          <f>3000</f>
        </calibration>
        <calibration type="frame" class="adjusted">
          <resolution width="5280" height="3956"/>
          <f>3705.5</f>
          <cx>11.5</cx>
          <cy>-27.75</cy>
          <b1>0.5</b1>
          <k1>-0.09</k1>
          <k2>-0.07</k2>
          <k3>0.11</k3>
          <p1>-0.0003</p1>
          <p2>0.0001</p2>
        </calibration>
        <covariance><params>f cx cy</params><coeffs>1 0 0 0 1 0 0 0 1</coeffs></covariance>
      </sensor>"""
EXAMPLE = f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0">
  <chunk label="Chunk 1" enabled="true">
    <sensors next_id="1">{SENSOR}
    </sensors>
    <components next_id="1" active_id="0">
      <component id="0" label="Component 1">
        <transform>
          <rotation locked="true">0 -1 0 1 0 0 0 0 1</rotation>
          <translation locked="true">10 20 30</translation>
          <scale locked="true">2</scale>
        </transform>
        <partition><camera_ids>0 1</camera_ids></partition>
      </component>
    </components>
    <cameras next_id="4" next_group_id="1">
      <camera id="0" sensor_id="0" component_id="0" label="DJI_0001">
        <transform>1 0 0 5 0 -1 0 6 0 0 -1 7 0 0 0 1</transform>
        <rotation_covariance>1 0 0 0 1 0 0 0 1</rotation_covariance>
        <orientation>1</orientation>
        <reference x="-120.41" y="39.41" z="2420.1" yaw="179.9" pitch="0.1" roll="-0" enabled="true"/>
      </camera>
      <group id="0" label="Group 1" type="folder">
        <camera id="1" sensor_id="0" component_id="0" label="/home/me/flight/DJI_0002.JPG">
          <transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform>
        </camera>
        <camera id="2" sensor_id="0" label="DJI_0003"/>
        <camera id="3" sensor_id="0" component_id="0" label="DJI_0004" enabled="false">
          <transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform>
        </camera>
      </group>
    </cameras>
    <reference>LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0]]</reference>
  </chunk>
</document>
"""
WGS84 = 'GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,298.257223563]]]'


def written(folder: Path, text: str = EXAMPLE) -> Path:
    (folder / "cameras.xml").write_text(text)
    return folder / "cameras.xml"


def quiet(path: Path) -> Reconstruction:
    with pytest.warns(RuntimeWarning):
        return read_metashape(path)


def test_a_file_in_the_form_of_metashape(tmp_path: Path) -> None:
    path = written(tmp_path)
    (tmp_path / "images").mkdir()
    Image.new("RGB", (8, 8)).save(tmp_path / "images" / "DJI_0001.JPG")
    with pytest.warns(RuntimeWarning) as caught:
        model = read_metashape(path)
    texts = sorted(str(each.message) for each in caught)
    assert "cameras without a pose are not read: 1 (DJI_0003)" in texts[0]
    assert "disabled cameras are not read: 1 (DJI_0004)" in texts[1]
    assert model.images.name == ("DJI_0001.JPG", "home/me/flight/DJI_0002.JPG")
    # u = w / 2 + cx, where the center of the first pixel is 0.5; b1 is of fx; p1 and p2 are exchanged.
    camera = model.cameras[0]
    assert camera.model == CameraModel.FULL_OPENCV and (camera.width, camera.height) == (5280, 3956)
    center = [2640 + 11.5 - 0.5, 1978 - 27.75 - 0.5]
    np.testing.assert_allclose(
        camera.params, [3706.0, 3705.5, *center, -0.09, -0.07, 0.0001, -0.0003, 0.11, 0, 0, 0]
    )
    # The position 5 6 7 in the chunk, rotated by 90 degrees about z, doubled, and moved.
    np.testing.assert_allclose(model.camera_centers_in_world(), [[-2, 30, 44], [10, 20, 30]], atol=1e-12)
    # The first camera looks down: its z is -z of the chunk, its x is x of the chunk, which is y of the world.
    np.testing.assert_allclose(
        model.cams_from_world().rotation[0], [[0, 1, 0], [1, 0, 0], [0, 0, -1]], atol=1e-12
    )
    assert model.georeference is None and len(model.points) == 0


def test_projection_is_that_of_the_manual(tmp_path: Path) -> None:
    model = quiet(written(tmp_path))
    x, y = 0.2, -0.15
    r2 = x * x + y * y
    radial = 1 - 0.09 * r2 - 0.07 * r2**2 + 0.11 * r2**3
    p1, p2 = -0.0003, 0.0001
    x2 = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    y2 = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    u, v = 2640 + 11.5 + x2 * 3705.5 + x2 * 0.5, 1978 - 27.75 + y2 * 3705.5
    found = model.cameras[0].project(np.array([[2 * x, 2 * y, 2.0]]))[0]
    np.testing.assert_allclose(found + 0.5, [u, v], atol=1e-9)


def test_fisheye(tmp_path: Path) -> None:
    text = EXAMPLE.replace('type="frame"', 'type="fisheye"')
    text = text.replace("<p1>-0.0003</p1>", "<k4>0.02</k4>").replace("<p2>0.0001</p2>", "")
    camera = quiet(written(tmp_path, text)).cameras[0]
    assert camera.model == CameraModel.OPENCV_FISHEYE
    np.testing.assert_allclose(camera.params[4:], [-0.09, -0.07, 0.11, 0.02])


def test_earth_centered_coordinates_become_local(tmp_path: Path) -> None:
    text = EXAMPLE.replace(EXAMPLE[EXAMPLE.index("LOCAL_CS") : EXAMPLE.index("</reference>")], WGS84)
    text = text.replace(">10 20 30<", ">4177000 855000 4728000<")
    model = quiet(written(tmp_path, text))
    origin = model.georeference
    assert origin is not None and abs(origin.lat_deg - 48.15) < 0.1 and abs(origin.lon_deg - 11.57) < 0.1
    assert np.abs(model.camera_centers_in_world()).max() < 20
    expected = np.array([[4177000 - 12, 855000 + 10, 4728000 + 14], [4177000, 855000, 4728000.0]])
    found = origin.lat_lon_alt_of(model.camera_centers_in_world())
    np.testing.assert_allclose(found[:, :2], lat_lon_alt_from_ecef(expected)[:, :2], atol=1e-9)
    np.testing.assert_allclose(found[:, 2], lat_lon_alt_from_ecef(expected)[:, 2], atol=1e-5)


def test_a_survey_flight(tmp_path: Path) -> None:
    """Numbers of a real file: the camera is at its GPS position and looks down, with the top of the image to the south."""
    text = EXAMPLE.replace(EXAMPLE[EXAMPLE.index("LOCAL_CS") : EXAMPLE.index("</reference>")], WGS84)
    rotation = "0.8710699454 0.3070967021 -0.3833128821 -0.4909742007 0.5658364395 -0.6623997719 0.0134716110 0.7651932691 0.6436596744"
    text = text.replace(">0 -1 0 1 0 0 0 0 1<", f">{rotation}<")
    text = text.replace(">10 20 30<", ">-2499366.429888 -4256836.520906 4029217.965003<")
    text = text.replace(">2</scale>", ">12.354192447331316</scale>")
    for old in ("1 0 0 5 0 -1 0 6 0 0 -1 7 0 0 0 1", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"):
        text = text.replace(
            old,
            "-0.99988146 -0.00872749 0.01268391 7.04224697 -0.00842932 0.99969124 0.02337453 7.05403071 "
            "-0.01288400 0.02326485 -0.99964631 0.43561421 0 0 0 1",
        )
    model = quiet(written(tmp_path, text))
    assert model.georeference is not None
    lat_deg, lon_deg, alt_m = model.georeference.lat_lon_alt_of(model.camera_centers_in_world()[:1])[0]
    assert lat_deg == pytest.approx(39.41191747, abs=1e-6) and lon_deg == pytest.approx(
        -120.417985477, abs=1e-6
    )
    assert alt_m == pytest.approx(2420.109, abs=0.05)
    right, down, ahead = model.cams_from_world().rotation[0]
    np.testing.assert_allclose(ahead, [0, 0, -1], atol=0.02)
    np.testing.assert_allclose(down, [0, 1, 0], atol=0.04)
    np.testing.assert_allclose(right, [-1, 0, 0], atol=0.04)


def test_another_datum_gives_no_position_on_earth(tmp_path: Path) -> None:
    text = EXAMPLE.replace("LOCAL_CS", 'GEOGCS["NAD83",').replace(">10 20 30<", ">4177000 855000 4728000<")
    with pytest.warns(RuntimeWarning) as caught:
        assert read_metashape(written(tmp_path, text)).georeference is None
    assert any("its coordinate system does not name WGS 84" in str(each.message) for each in caught)


@pytest.mark.parametrize("model", [small_model(), mappable_model()])
def test_there_and_back(tmp_path: Path, model: Reconstruction) -> None:
    known = np.flatnonzero(model.is_registered())
    for name in model.images.name:
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "images" / name).touch()
    write_metashape(model, tmp_path / "cameras.xml")
    found = read_model(tmp_path)
    assert found.images.name == tuple(model.images.name[k] for k in known)
    matrices = model.cams_from_world().as_matrix()[known]
    np.testing.assert_allclose(found.cams_from_world().as_matrix(), matrices, atol=1e-12)
    points = model.points.xyz_in_world + np.array([0.0, 0.0, 5.0])
    for image, row in enumerate(known):
        one, other = (
            each.cameras[int(each.camera_of_image[k])] for each, k in ((found, image), (model, row))
        )
        assert (one.width, one.height) == (other.width, other.height)
        np.testing.assert_allclose(one.project(points), other.project(points), atol=1e-9)


def test_the_position_on_earth_stays(tmp_path: Path) -> None:
    model = replace(mappable_model(), georeference=Georeference(-33.86, 151.21, 40.0))
    write_metashape(model, tmp_path / "cameras.xml")
    found = read_metashape(tmp_path / "cameras.xml")
    assert found.georeference is not None and model.georeference is not None
    one = found.georeference.lat_lon_alt_of(found.camera_centers_in_world())
    other = model.georeference.lat_lon_alt_of(model.camera_centers_in_world())
    np.testing.assert_allclose(one, other, atol=1e-8)
    distances = [
        np.linalg.norm(np.diff(each.camera_centers_in_world(), axis=0), axis=1) for each in (found, model)
    ]
    np.testing.assert_allclose(*distances, atol=1e-8)


def test_labels_are_names_without_suffix_where_these_are_unique(tmp_path: Path) -> None:
    model = mappable_model()
    names = ("a/1.jpg", "a/2.jpg", "a/2.png", "b.tar", "5", "6.JPG")
    write_metashape(replace(model, images=replace(model.images, name=names)), tmp_path / "c.xml")
    found = read_metashape(tmp_path / "c.xml").images.name
    assert found == ("a/1", "a/2.jpg", "a/2.png", "b.tar", "5", "6")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("<p1>", "<k4>0.1</k4><p1>", "sensor '0': k4 = 0.1 of a frame camera is not supported"),
        ("<p1>", "<b2>-0.3</b2><p1>", "b2 = -0.3 of a frame camera"),
        ("<p1>", "<p3>0.1</p3><p1>", "p3 = 0.1 in a calibration is not supported"),
        ("<p1>", "<k1>0.1</k1><p1>", "duplicate value k1"),
        ('type="frame"', 'type="fisheye"', "p1 = -0.0003 of a fisheye camera"),
        ('type="frame"', 'type="equisolid_fisheye"', "cameras of the type 'equisolid_fisheye'"),
        ('type="frame"', 'type="spherical"', "spherical"),
        ("<f>3705.5</f>", "", "no focal length f"),
        ("<f>3705.5</f>", "<f>nan</f>", "f is not a finite number, got 'nan'"),
        ("<f>3705.5</f>", "<f>-1</f>", "sensor '0'"),
        ('<resolution width="5280"', '<resolution width="0"', "invalid image size width = 0"),
        ("1 0 0 5 0 -1 0 6", "1 0 0 5 0 1 0 6", "the transform of 'DJI_0001' is not a rigid motion"),
        ("1 0 0 5 0 -1 0 6", "1 0 0 5 0 -1 0", "is not 4 x 4 numbers"),
        ("1 0 0 5 0 -1 0 6", "1 0 0 inf 0 -1 0 6", "is not a finite number"),
        (">2</scale>", ">0</scale>", "a rotation and a positive scale"),
        (">10 20 30<", "><", "the translation of the chunk is not 3 numbers"),
        ('sensor_id="0" component_id="0" label="DJI_0001"', 'sensor_id="9" label="a"', "the sensor '9'"),
        ('label="DJI_0001"', 'label="../a"', "does not name a file inside"),
        ('label="DJI_0001"', 'label="home/me/flight/DJI_0002.JPG"', "two cameras have the label"),
        ("<transform>", "<position>", "not XML"),
        ("<document", "<project", "not XML"),
        ("<?xml", '<!DOCTYPE a [<!ENTITY b "c">]><?xml', "it defines XML entities"),
        ("LOCAL_CS", WGS84, "the cameras are not on Earth"),
        (EXAMPLE, "", "not XML"),
        (EXAMPLE, "<project/>", "not cameras of Metashape"),
        (EXAMPLE, "<document><chunk/></document>", "no camera has a pose"),
        (EXAMPLE, EXAMPLE[:1500], "not XML"),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in EXAMPLE
    with pytest.raises(FileFormatError, match=words) as caught:
        read_metashape(written(tmp_path, EXAMPLE.replace(old, new)))
    assert "cameras.xml" in str(caught.value)


def test_what_the_format_cannot_store_is_refused(tmp_path: Path) -> None:
    rational = np.array([500.0, 500.0, 320.0, 240.0, 0, 0, 0, 0, 0, 0.1, 0, 0])
    cameras = Cameras.from_list([Camera(CameraModel.FULL_OPENCV, 640, 480, rational)])
    model = mappable_model()
    with pytest.raises(ConfigError, match="no rational camera model"):
        write_metashape(replace(model, cameras=cameras), tmp_path / "c.xml")
    images = replace(model.images, name=("a\x01.jpg", *model.images.name[1:]))
    with pytest.raises(ConfigError, match="cannot be written to an XML file"):
        write_metashape(replace(model, images=images), tmp_path / "c.xml")
    assert not list(tmp_path.iterdir())
