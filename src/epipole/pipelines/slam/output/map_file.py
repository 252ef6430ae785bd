"""Map files, written atomically, in which SLAM can continue or localize later."""

from __future__ import annotations

from collections.abc import Sequence, Set
from pathlib import Path
from typing import NamedTuple

import numpy as np

from epipole._checks import as_path
from epipole._checks.tables import TEXT, Arrays, Expected, Table
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, EpipoleError, FileFormatError, ShapeError
from epipole.geometry import Rigid3
from epipole.io.contents_in_words import with_what_it_is
from epipole.pipelines.slam.frames import SlamCamera
from epipole.pipelines.slam.loops.recognition import describe_keyframe
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap
from epipole.runs.units import is_done, load, store, stored_key
from epipole.scene import CameraRig

MAP_FILE = Path("map") / "map.npz"
VERSION = "epipole map 1"
SAME_PARAMS, SAME_ROTATION = 0.02, 0.01
"""Tolerated difference of a map's camera: relative, of parameters and of positions on a rig; and of entries of rotation matrices."""
TABLE: Table = {
    "camera_model": Expected("int64"),
    "camera_params": Expected("float64", "_"),
    "size": Expected("int64", "2", least=1),
    "is_metric": Expected("bool"),
    "scale": Expected(TEXT, is_optional=True),  # older files lack it
    "right_shift_px": Expected("float64"),
    "number": Expected("int64", "k", least=0, most=1 << 53),
    "name": Expected(TEXT, "k"),
    "timestamp_s": Expected("float64", "k"),
    "rotation": Expected("float64", "k 3 3", is_rotation=True),
    "translation": Expected("float64", "k 3"),
    "grey": Expected("uint8", "k h w"),
    "offsets": Expected("int64", "k+1", rises_to="n"),
    "pixels": Expected("float64", "n 2"),
    "disparity_px": Expected("float64", "n", may_be_nan=True),
    "point": Expected("int64", "n", below="p"),
    "xyz": Expected("float64", "p 3", may_be_nan=True),
    "anchor": Expected("int64", "p", least=-1, below="k"),
    "anchor_px": Expected("float64", "p 2"),
    "num_agreed": Expected("int64", "p", least=0),
    "rig_model": Expected("int64", "r", is_optional=True),
    "rig_params": Expected("float64", "r 12", is_optional=True),
    "rig_size": Expected("int64", "r 2", least=1, is_optional=True),
    "rig_rotation": Expected("float64", "r 3 3", is_rotation=True, is_optional=True),
    "rig_translation": Expected("float64", "r 3", is_optional=True),
}
"""Arrays of the file: k keyframes, n observations, p points, r cameras of a rig."""


class KnownMap(NamedTuple):
    """A map from a file."""

    model: SlamMap
    names: tuple[str, ...]
    """Image names of the keyframes."""
    numbers: tuple[int, ...]
    """Frame numbers of the keyframes."""
    is_metric: bool
    scale: str = ""
    """Source of the metric scale, as described by the run that made the map; empty if unknown."""


def distinct_names(names: Sequence[str], taken: Set[str], folder: str) -> tuple[str, ...]:
    """The names, made unique by a folder before each one that is taken or repeated: two runs often give their images the same names."""
    out, given, used = [], set(names), set(taken)
    for name in names:
        distinct = name
        while distinct in used or (distinct != name and distinct in given):
            distinct = f"{folder}/{distinct}"
        used.add(distinct)
        out.append(distinct)
    return tuple(out)


def write_slam_map(
    path: str | Path, model: SlamMap, names: Sequence[str], sensor: SlamCamera, scale: str = ""
) -> None:
    """Write a map.

    Args:
        path: the file.
        model: the map; rotation-only keyframes, which see no points, are not written.
        names: image names, one for each of the model's keyframes.
        sensor: camera of the map.
        scale: source of the metric scale; if empty, the map is metric only if the camera measures depth.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    number = {id(k): n for n, k in enumerate(k for k in model.keyframes if len(k.point))}
    keyframes = [k for k in model.keyframes if len(k.point)]
    column = np.array([number.get(id(k), -1) for k in model.keyframes], np.int64)
    camera = sensor.camera
    size = (sensor.camera_or_rig.height, sensor.camera_or_rig.width)
    arrays = {
        "camera_model": np.array(int(camera.model)),
        "camera_params": camera.params,
        "size": np.array(size[::-1]),
        "is_metric": np.array(sensor.is_metric or bool(scale)),
        "scale": np.array(scale),
        "right_shift_px": np.array(model.right_shift_px),
        "number": np.array([k.number for k in keyframes], np.int64),
        "name": np.array([n for n, k in zip(names, model.keyframes) if len(k.point)], np.str_),
        "timestamp_s": np.array([k.timestamp_s for k in keyframes], np.float64),
        "rotation": np.array([k.cam_from_world.rotation for k in keyframes]).reshape(-1, 3, 3),
        "translation": np.array([k.cam_from_world.translation for k in keyframes]).reshape(-1, 3),
        "grey": np.array([k.gray for k in keyframes], np.uint8).reshape(-1, *size),
        "offsets": np.concatenate([[0], np.cumsum([len(k.point) for k in keyframes])]).astype(np.int64),
        "pixels": np.concatenate([np.zeros((0, 2)), *(k.pixels for k in keyframes)]),
        "disparity_px": np.concatenate([np.zeros(0), *(k.disparity_px for k in keyframes)]),
        "point": np.concatenate([np.zeros(0, np.int64), *(k.point for k in keyframes)]),
        "xyz": model.xyz,
        "anchor": column[model.anchor],
        "anchor_px": model.anchor_px,
        "num_agreed": model.num_agreed,
    }
    store(as_path(path), VERSION, arrays | _rig_arrays(sensor.rig))


class MapSummary(NamedTuple):
    """The visible content of a map."""

    camera: Camera
    """The first one of a rig."""
    names: tuple[str, ...]
    """Image names of the keyframes."""
    cams_from_world: Rigid3
    gray: np.ndarray
    """Images of the keyframes (k, h, w); of the first camera of a rig."""
    xyz_in_world: np.ndarray
    """Triangulated points (n, 3)."""
    num_agreed: np.ndarray
    is_metric: bool


def summary_of_map(path: str | Path) -> MapSummary:
    """Read the visible content of a map, without what SLAM needs to continue in it.

    Args:
        path: the file, the folder `map`, or the output folder of a run.

    Raises:
        FileFormatError: the file is not a map, or damaged.
    """
    arrays = _arrays(map_file_of(as_path(path)))
    localized = np.isfinite(arrays["xyz"]).all(axis=1) & (arrays["anchor"] >= 0)
    camera, poses = _camera_of(arrays), Rigid3(arrays["rotation"], arrays["translation"])
    rig = _rig_of(arrays)
    return MapSummary(
        camera,
        tuple(str(n) for n in arrays["name"]),
        poses if rig is None else rig.cam_from_rig[0] @ poses,
        arrays["grey"][:, : camera.height, : camera.width],
        arrays["xyz"][localized],
        arrays["num_agreed"][localized],
        bool(arrays["is_metric"]),
    )


def camera_of_map(path: str | Path) -> Camera:
    """Intrinsics of the camera that made a map, the first one of a rig.

    Args:
        path: the file, the folder `map`, or the output folder of a run.

    Raises:
        FileFormatError: the file is not a map, or damaged.
    """
    return _camera_of(_arrays(map_file_of(as_path(path))))


def require_map(path: Path) -> None:
    """Check that a path is a map or a folder with one.

    Raises:
        FileFormatError: there is no map, or it is damaged or of another version.
    """
    file = map_file_of(as_path(path))
    if not is_done(file, VERSION):
        _arrays(file)


def map_file_of(path: Path) -> Path:
    """The map's file: the path, or the file in an output folder or in its folder `map`."""
    return next((p for p in (path / MAP_FILE, path / MAP_FILE.name) if p.exists()), path)


def load_slam_map(path: str | Path) -> SlamMap:
    """Read a map without a camera to localize in it.

    Raises:
        FileFormatError: the file is not a map, or damaged.
    """
    return _model_of(_arrays(map_file_of(as_path(path))))


def read_slam_map(path: str | Path, sensor: SlamCamera) -> KnownMap:
    """Read a map and describe its keyframes for relocalization.

    Args:
        path: the file, the folder `map`, or the output folder of a run.
        sensor: the camera to localize in the map.

    Raises:
        FileFormatError: the file is not a map, or damaged.
        ConfigError: the map was made with another camera, or is up to scale although this camera measures depth.
    """
    path = map_file_of(as_path(path))
    arrays = _arrays(path)
    camera, camera_or_rig = sensor.camera, sensor.camera_or_rig
    size, params = arrays["size"], arrays["camera_params"]
    if not _is_same_rig(_rig_of(arrays), sensor.rig):
        raise ConfigError(f"the map {path} was made with another camera or rig of cameras")
    if (int(size[0]), int(size[1])) != (camera_or_rig.width, camera_or_rig.height):
        raise ConfigError(
            f"the map {path} was made from images of {size[0]}x{size[1]}, but these are {camera_or_rig.width}x{camera_or_rig.height}"
        )
    if int(arrays["camera_model"]) != int(camera.model) or not np.allclose(
        params, camera.params, rtol=SAME_PARAMS
    ):
        raise ConfigError(f"{path} is the map of another camera: {params} instead of {camera.params}")
    if sensor.is_metric and not arrays["is_metric"]:
        raise ConfigError(f"the map {path} is up to scale: use it with one camera")
    scale = arrays.get("scale")
    return KnownMap(
        _model_of(arrays),
        tuple(str(n) for n in arrays["name"]),
        tuple(int(n) for n in arrays["number"]),
        bool(arrays["is_metric"]),
        "" if scale is None else str(scale),
    )


def _arrays(path: Path) -> Arrays:
    """Read and check the arrays of a map file.

    Raises:
        FileFormatError: the file is not a map or damaged, or its arrays do not fit each other.
    """
    if not is_done(path, VERSION):
        key = stored_key(path) if path.is_file() else ""
        why = f"the version is not supported ({key})" if key not in ("", VERSION) else "not a map, or damaged"
        if not path.is_file():
            why = f"contains no SLAM map ({MAP_FILE})"
        advice = "pass the output folder of an earlier `epipole slam`"
        raise FileFormatError(path, with_what_it_is(why, path, advice))
    try:
        arrays = load(path, TABLE)
        _check(arrays)
        _camera_of(arrays)
    except (EpipoleError, ValueError) as error:
        raise FileFormatError(path, f"the arrays are not those of a map ({error})") from error
    return arrays


def _camera_of(arrays: Arrays) -> Camera:
    rig = _rig_of(arrays)
    if rig is not None:
        return rig.cameras[0]
    width, height = (int(side) for side in arrays["size"])
    return Camera(CameraModel(int(arrays["camera_model"])), width, height, arrays["camera_params"])


def _rig_arrays(rig: CameraRig | None) -> dict[str, np.ndarray]:
    if rig is None:
        return {}
    return {
        "rig_model": np.array([int(camera.model) for camera in rig.cameras]),
        "rig_params": np.array([camera.padded_params() for camera in rig.cameras]),
        "rig_size": np.array([(camera.width, camera.height) for camera in rig.cameras]),
        "rig_rotation": rig.cam_from_rig.rotation,
        "rig_translation": rig.cam_from_rig.translation,
    }


def _rig_of(arrays: Arrays) -> CameraRig | None:
    """The rig of the map; None for a single camera.

    Raises:
        EpipoleError: the arrays are not those of a rig.
    """
    if not any(name.startswith("rig_") for name in arrays):
        return None
    missing = [name for name in TABLE if name.startswith("rig_") and name not in arrays]
    if missing:
        raise ShapeError(f"the arrays {', '.join(missing)} of the rig are missing")
    cameras = []
    for model, params, size in zip(arrays["rig_model"], arrays["rig_params"], arrays["rig_size"].tolist()):
        kind = CameraModel(int(model))
        cameras.append(Camera(kind, size[0], size[1], params[: kind.num_params]))
    return CameraRig(tuple(cameras), Rigid3(arrays["rig_rotation"], arrays["rig_translation"]))


def _is_same_rig(one: CameraRig | None, other: CameraRig | None) -> bool:
    if one is None or other is None:
        return one is other
    if len(one.cameras) != len(other.cameras):
        return False
    moved = one.cam_from_rig @ other.cam_from_rig.inverse()
    is_mounted_alike = bool(
        (np.abs(moved.rotation - np.eye(3)) < SAME_ROTATION).all()
        and (np.linalg.norm(moved.translation, axis=1) <= SAME_PARAMS * one.length).all()
    )
    return is_mounted_alike and all(
        (a.model, a.width, a.height) == (b.model, b.width, b.height)
        and np.allclose(a.params, b.params, rtol=SAME_PARAMS)
        for a, b in zip(one.cameras, other.cameras)
    )


def _check(arrays: Arrays) -> None:
    """Check what the table does not cover.

    Raises:
        ShapeError: the images do not have the camera's size, or a keypoint is outside its image.
    """
    width, height = arrays["size"].tolist()
    if arrays["grey"].shape[1:] != (height, width):
        raise ShapeError(f"grey must contain images of {width} x {height}, got {arrays['grey'].shape}")
    for name in ("pixels", "anchor_px"):
        if not ((arrays[name] > -1.0) & (arrays[name] < arrays["size"])).all():
            raise ShapeError(f"{name} must be inside the image")


def _model_of(arrays: Arrays) -> SlamMap:
    model, offsets = SlamMap(), arrays["offsets"]
    # Points whose anchor keyframe was not saved cannot be used.
    xyz = np.where(arrays["anchor"][:, None] >= 0, arrays["xyz"], np.nan)
    rows = model.add_points(xyz, arrays["anchor_px"], np.maximum(arrays["anchor"], 0))
    model.num_agreed[rows] = arrays["num_agreed"]
    model.right_shift_px = float(arrays["right_shift_px"])
    for k, number in enumerate(arrays["number"]):
        own = slice(offsets[k], offsets[k + 1])
        position = Rigid3(arrays["rotation"][k], arrays["translation"][k])
        seen = Observations(*(arrays[name][own].copy() for name in ("pixels", "disparity_px", "point")))
        gray = np.ascontiguousarray(arrays["grey"][k], np.uint8)
        keyframe = Keyframe(int(number), float(arrays["timestamp_s"][k]), gray, position, seen)
        describe_keyframe(keyframe)
        model.keyframes.append(keyframe)
    return model
