"""The chunk in Metashape's XML: its images, and its position in the world."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from epipole.cameras import Camera
from epipole.errors import ConfigError
from epipole.geometry import Rotation3, Similarity3
from epipole.geometry.geodesy import enu_from_ecef_rotation, lat_lon_alt_from_ecef
from epipole.io._named_numbers import is_rotation
from epipole.io.models._metashape_cameras import camera_of_sensor, number_of
from epipole.scene import Georeference

_LOCAL, _WGS84 = "LOCAL_CS", ("WGS 84", "WGS_1984", "WGS84")
"""Start of a local coordinate system, and names of the datum in others, in well-known text."""
_NO_POSE, _DISABLED = "cameras without a pose", "disabled cameras"
_ELSEWHERE = "cameras of other components"
_NAMES_SHOWN = 3
_MOST_SCALE, _FARTHEST = 1e12, 1e12


@dataclass(frozen=True, slots=True, eq=False)
class ChunkImages:
    """The images of a chunk that have a pose."""

    labels: list[str]
    cameras: list[Camera]
    camera_rows: list[int]
    """Camera of each image."""
    chunks_from_cams: list[np.ndarray]
    component: str | None
    """The component of the images; None if there are none."""
    warnings: list[str]


def chunk_of_text(text: str) -> tuple[Element, list[str]]:
    """The chunk with the most cameras in the text of a file, and a warning if there are others.

    Raises:
        ConfigError: not XML with a chunk.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ConfigError("it defines XML entities")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise ConfigError(f"not XML: {error}; check that this is the right file, and complete") from error
    chunks = [root] if root.tag == "chunk" else root.findall("chunk") if root.tag == "document" else []
    if not chunks:
        raise ConfigError("not cameras of Metashape (no document with a chunk)")
    largest = max(chunks, key=lambda chunk: len(list(_cameras_in(chunk))))
    return largest, [] if len(chunks) == 1 else [f"it has {len(chunks)} chunks; only the largest is read"]


def _cameras_in(chunk: Element) -> Iterator[Element]:
    """The cameras, also those in groups."""
    for parent in chunk.findall("cameras"):
        yield from parent.iter("camera")


def images_of_chunk(chunk: Element) -> ChunkImages:
    """The images of the component with the most images.

    Raises:
        ConfigError: a camera's sensor is missing or not supported, or a pose is not a rigid motion.
    """
    sensors = {sensor.get("id", ""): sensor for sensor in chunk.iterfind("sensors/sensor")}
    left_out: dict[str, list[str]] = {_NO_POSE: [], _DISABLED: [], _ELSEWHERE: []}
    posed = []
    for camera in _cameras_in(chunk):
        if camera.get("enabled", "true").lower() in ("false", "0"):
            left_out[_DISABLED].append(camera.get("label", ""))
        elif camera.find("transform") is None:
            left_out[_NO_POSE].append(camera.get("label", ""))
        else:
            posed.append(camera)
    if not posed:
        raise ConfigError("no camera has a pose (a transform)")
    counts = Counter(camera.get("component_id") for camera in posed)
    component = counts.most_common(1)[0][0]
    row_of_sensor: dict[str, int] = {}
    out = ChunkImages([], [], [], [], component, [])
    for camera in posed:
        label, sensor = camera.get("label", ""), camera.get("sensor_id", "")
        if camera.get("component_id") != component:
            left_out[_ELSEWHERE].append(label)
            continue
        if sensor not in row_of_sensor:
            row_of_sensor[sensor] = len(row_of_sensor)
            out.cameras.append(_camera_of(sensor, sensors))
        out.labels.append(label)
        out.camera_rows.append(row_of_sensor[sensor])
        out.chunks_from_cams.append(_rigid_motion(camera, label))
    for what, labels in left_out.items():
        if labels:
            few = ", ".join(label[:80] for label in labels[:_NAMES_SHOWN])
            out.warnings.append(f"{what} are not read: {len(labels)} ({few})")
    return out


def _camera_of(key: str, sensors: dict[str, Element]) -> Camera:
    if key not in sensors:
        raise ConfigError(f"a camera has the sensor {key[:40]!r}, which does not exist")
    try:
        return camera_of_sensor(sensors[key])
    except ConfigError as error:
        raise ConfigError(f"sensor {key[:40]!r}: {error}") from error


def _rigid_motion(camera: Element, label: str) -> np.ndarray:
    """chunk_from_cam as (4, 4)."""
    matrix = _matrix(camera.find("transform"), f"the transform of {label[:80]!r}", (4, 4))
    if not is_rotation(matrix[:3, :3]) or (matrix[3] != [0.0, 0.0, 0.0, 1.0]).any():
        raise ConfigError(f"the transform of {label[:80]!r} is not a rigid motion")
    matrix[:3, :3] = Rotation3.nearest(matrix[:3, :3]).matrix
    return matrix


def _matrix(element: Element | None, what: str, shape: tuple[int, ...]) -> np.ndarray:
    words = (element.text or "").split() if element is not None else []
    values = np.array([number_of(word, what) for word in words])
    if values.size != np.prod(shape):
        raise ConfigError(f"{what} is not {' x '.join(map(str, shape))} numbers")
    if not (np.abs(values) < _FARTHEST).all():
        raise ConfigError(f"{what} has a number that is too large")
    return values.reshape(shape)


def world_from_chunk(
    chunk: Element, component: str | None, centers_in_chunk: np.ndarray
) -> tuple[Similarity3, Georeference | None, list[str]]:
    """The similarity to world coordinates, their origin on Earth if it is known, and warnings.

    Args:
        chunk: the chunk.
        component: the component of its images.
        centers_in_chunk: (n, 3) positions of the cameras.

    Raises:
        ConfigError: the transform is not a similarity.
    """
    components = chunk.findall("components/component")
    transform = next((each.find("transform") for each in components if each.get("id") == component), None)
    transform = chunk.find("transform") if transform is None else transform
    if transform is None or not len(transform):
        return Similarity3.identity(), None, []
    rotation = _matrix(transform.find("rotation"), "the rotation of the chunk", (3, 3))
    translation = _matrix(transform.find("translation"), "the translation of the chunk", (3,))
    scale = float(_matrix(transform.find("scale"), "the scale of the chunk", (1,))[0])
    if not is_rotation(rotation) or not 1.0 / _MOST_SCALE < scale < _MOST_SCALE:
        raise ConfigError("the transform of the chunk is not a rotation and a positive scale")
    world = Similarity3(np.array(scale), Rotation3.nearest(rotation).matrix, translation)
    reference = (chunk.findtext("reference") or "").strip()
    if not reference or reference.startswith(_LOCAL):
        return world, None, []
    origin_in_ecef = np.median(world.apply(centers_in_chunk), axis=0)
    lat_deg, lon_deg, alt_m = lat_lon_alt_from_ecef(origin_in_ecef[None])[0].tolist()
    try:
        georeference = Georeference(lat_deg, lon_deg, alt_m)
    except ConfigError as error:
        raise ConfigError(
            f"the coordinate system is {reference[:40]}, but the cameras are not on Earth"
        ) from error
    enu_from_ecef = enu_from_ecef_rotation(lat_deg, lon_deg)
    enu = Similarity3(np.array(1.0), enu_from_ecef, -enu_from_ecef @ origin_in_ecef) @ world
    if any(name in reference for name in _WGS84):
        return enu, georeference, []
    unknown = (
        f"its coordinate system does not name WGS 84 ({reference[:60]}); the position on Earth is not read"
    )
    return enu, None, [unknown]
