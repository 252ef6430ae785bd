"""Agisoft Metashape's cameras as XML (File > Export > Export Cameras).

The transform of a camera is chunk_from_cam, with x right, y down, z forward; that of a component, or of the chunk, is
world_from_chunk, a similarity. If the chunk has geographic or projected coordinates, that world is Earth-centered; here, it
becomes east, north and up of the middle of the cameras. A label is the name of an image without its suffix.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from epipole._checks import checked
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3, Similarity3
from epipole.geometry.geodesy import ecef_from_lat_lon_alt, enu_from_ecef_rotation
from epipole.io.atomic import atomic_write
from epipole.io.files import file_text, problem_of_name
from epipole.io.images.formats import FORMAT_OF_SUFFIX
from epipole.io.models._metashape_cameras import calibration_values
from epipole.io.models._metashape_chunks import chunk_of_text, images_of_chunk, world_from_chunk
from epipole.io.models.model_file import ModelFile, Observations, model_of_single_images, no_points
from epipole.io.names import is_inside_name
from epipole.scene import Georeference, Reconstruction

CAMERAS_XML = "cameras.xml"
"""Name of the file that `epipole convert` writes."""
IMAGE_FOLDER = "images"
"""Folder beside the file in which images are searched."""

_MOST_BYTES = 1 << 28
_SUFFIXES = tuple(case for suffix in FORMAT_OF_SUFFIX for case in (suffix, suffix.upper()))
_ROOT = re.compile(r"([A-Za-z]:)?/*")
"""Start of an absolute path, which some labels are."""
_NOT_IN_XML = re.compile("[\x00-\x1f\ud800-\udfff\ufffe\uffff]")
_VERSION = "2.0.0"
_WGS84 = (
    'GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
    'TOWGS84[0,0,0,0,0,0,0],AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
    'UNIT["degree",0.01745329251994328,AUTHORITY["EPSG","9102"]],AUTHORITY["EPSG","4326"]]'
)


@checked
def write_metashape(reconstruction: Reconstruction, path: str | Path) -> None:
    """Write the registered images and their cameras; the format has no points, tracks and rigs.

    Args:
        reconstruction: the model to write. With a georeference, the coordinates are Earth-centered, else local.
        path: the XML file.

    Raises:
        ConfigError: Metashape has no such camera model, or an image's name cannot be written.
        WorkspaceError: the file cannot be written.
    """
    model = reconstruction
    worlds_from_cams, camera_of_image = model.cams_from_world().inverse(), model.camera_of_image
    registered = np.flatnonzero(model.is_registered()).tolist()
    document = Element("document", version=_VERSION)
    chunk = SubElement(document, "chunk", label="Chunk 1", enabled="true")
    sensors = SubElement(chunk, "sensors", next_id=str(len(model.cameras)))
    for row in sorted({int(camera_of_image[image]) for image in registered}):
        camera = model.cameras[row]
        kind, values = calibration_values(camera)
        size = {"width": str(camera.width), "height": str(camera.height)}
        sensor = SubElement(sensors, "sensor", id=str(row), label=f"camera {row}", type=kind)
        SubElement(sensor, "resolution", size)
        calibration = SubElement(sensor, "calibration", {"type": kind, "class": "adjusted"})
        SubElement(calibration, "resolution", size)
        for key, value in values.items():
            SubElement(calibration, key).text = repr(value)
    components = SubElement(chunk, "components", next_id="1", active_id="0")
    component = SubElement(components, "component", id="0", label="Component 1")
    _add_transform(component, model.georeference)
    SubElement(SubElement(component, "partition"), "camera_ids").text = " ".join(map(str, registered))
    cameras = SubElement(chunk, "cameras", next_id=str(len(model.images)), next_group_id="0")
    for image, label in zip(registered, _labels([model.images.name[image] for image in registered])):
        ids = {"id": str(image), "sensor_id": str(camera_of_image[image]), "component_id": "0"}
        entry = SubElement(cameras, "camera", ids, label=label)
        SubElement(entry, "transform").text = _text(worlds_from_cams[image].as_matrix())
    if model.georeference is not None:
        SubElement(chunk, "reference").text = _WGS84
    ElementTree.indent(document)
    with atomic_write(path) as part:
        part.write_bytes(ElementTree.tostring(document, encoding="UTF-8", xml_declaration=True) + b"\n")


def _add_transform(parent: Element, georeference: Georeference | None) -> None:
    ecef_from_enu = Similarity3.identity()
    if georeference is not None:
        position = np.array([[georeference.lat_deg, georeference.lon_deg, georeference.alt_m]])
        rotation = enu_from_ecef_rotation(georeference.lat_deg, georeference.lon_deg).T
        ecef_from_enu = Similarity3(np.array(1.0), rotation, ecef_from_lat_lon_alt(position)[0])
    transform = SubElement(parent, "transform")
    SubElement(transform, "rotation").text = _text(ecef_from_enu.rotation)
    SubElement(transform, "translation").text = _text(ecef_from_enu.translation)
    SubElement(transform, "scale").text = _text(ecef_from_enu.scale)


def _text(values: np.ndarray) -> str:
    return " ".join(map(repr, values.ravel().tolist()))


def _labels(names: list[str]) -> list[str]:
    """Names without suffix, or with it if several images have the same without.

    Raises:
        ConfigError: a name has a character that XML does not allow.
    """
    bad = next((name for name in names if _NOT_IN_XML.search(name)), None)
    if bad is not None:
        raise ConfigError(f"the image name {bad!a} cannot be written to an XML file")
    short = [_without_suffix(name) for name in names]
    count = Counter(short)
    return [label if count[label] == 1 else name for name, label in zip(names, short)]


def _without_suffix(name: str) -> str:
    path = PurePosixPath(name)
    return name.removesuffix(path.suffix) if path.suffix.lower() in FORMAT_OF_SUFFIX else name


@checked
def read_metashape(path: str | Path) -> Reconstruction:
    """Read the cameras of a file; the format has no points and no tracks.

    An image's name is its label. Where the file of an image is beside the XML file or in `images/`, its suffix is added.
    Issues a Python warning for everything in `ModelFile.warnings`.

    Args:
        path: the XML file.

    Raises:
        FileFormatError: not such a file, a value is invalid, or a camera's type or a coefficient is not supported.
    """
    return metashape_contents(path).warned()


@checked
def metashape_contents(path: str | Path) -> ModelFile:
    """Read the cameras of a file, and warnings about the rest of it.

    Args:
        path: as in `read_metashape`.

    Raises:
        FileFormatError: as in `read_metashape`.
    """
    path = Path(path)
    try:
        chunk, warnings = chunk_of_text(file_text(path, _MOST_BYTES))
        found = images_of_chunk(chunk)
        names = [_image_name(path.parent, label) for label in found.labels]
        twice = next((name for name, count in Counter(names).items() if count > 1), None)
        if twice is not None:
            raise ConfigError(f"two cameras have the label {twice[:80]!r}; rename one of them in Metashape")
        chunks_from_cams = Rigid3.from_matrix(np.array(found.chunks_from_cams))
        model = model_of_single_images(
            names,
            found.cameras,
            found.camera_rows,
            chunks_from_cams.inverse(),
            no_points(),
            Observations.none(),
        )
        world, georeference, more = world_from_chunk(chunk, found.component, chunks_from_cams.translation)
    except ConfigError as error:
        raise FileFormatError(path, str(error)) from error
    model = replace(model.transformed(world), georeference=georeference)
    return ModelFile(path, model, (*warnings, *found.warnings, *more))


def _image_name(folder: Path, label: str) -> str:
    """The path of an image relative to the folder or its folder of images, or the label if there is no such file."""
    if (problem := problem_of_name(label)) is not None:
        raise ConfigError(problem)
    name = _ROOT.sub("", label.replace("\\", "/"), count=1).removeprefix("./")
    if not is_inside_name(name):
        raise ConfigError(f"the label {label[:80]!a} does not name a file inside a folder")
    for root in (folder, folder / IMAGE_FOLDER):
        if (root / name).is_file():
            return name
        for suffix in _SUFFIXES:
            if (root / f"{name}{suffix}").is_file():
                return f"{name}{suffix}"
    return name
