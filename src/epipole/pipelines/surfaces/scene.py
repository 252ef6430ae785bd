"""3D view of a surface: its textured mesh, else the mesh, else the cloud, with the cameras, their images and their depth."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from epipole.cameras import Camera
from epipole.errors import EpipoleError, FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.image import color_map, undistort_image, undistorted_camera
from epipole.io.files import read_json
from epipole.io.meshes.gltf import read_glb
from epipole.io.meshes.mesh_ply import PlyMesh, first_view_of_mesh, read_mesh_ply
from epipole.io.models.images import ModelImages
from epipole.pipelines.sfm.notes import title_of
from epipole.pipelines.surfaces.depth_views import DEPTHS, DepthView, read_depth_views
from epipole.pipelines.surfaces.inputs import MODEL
from epipole.pipelines.surfaces.texture_stage import NAME
from epipole.report.markup import plural
from epipole.report.space import shuffled
from epipole.report.space_model import cameras_of_model, points_of_model, rig_curve
from epipole.report.space_scene import (
    METERS,
    NO_UNIT,
    CameraLayer,
    FirstView,
    MeshLayer,
    PointLayer,
    SpaceScene,
    TexturedMeshLayer,
)
from epipole.report.textured_layer import textured_layer
from epipole.runs import is_output_of, read_mark
from epipole.runs.model_source import ModelSource, is_model, model_source_of, up_in_world
from epipole.scene import Cameras
from epipole.scene.textured_mesh import TexturedMesh

KIND = "surface"
MESH, CLOUD = "mesh.ply", "cloud.ply"
SURFACES = (f"{NAME}.glb", MESH, CLOUD)
CAMERAS = "Cameras"
"""Name of the layer."""
IMAGE_PX = 640
MOST_POINTS = 2_000_000
"""Largest number of points of the cloud that are shown, an even sample of all."""
GRAY = 190


def is_mine(path: Path) -> bool:
    """Whether a path is an output folder of `surface`."""
    return is_output_of(path, KIND)


def read(path: Path) -> TexturedMesh | PlyMesh:
    """The textured mesh of an output folder, else the mesh, else the cloud.

    Raises:
        FileFormatError: the folder has none of them, or a file is damaged.
    """
    if (path / f"{NAME}.glb").is_file():
        return read_glb(path / f"{NAME}.glb")
    found = next((path / name for name in (MESH, CLOUD) if (path / name).is_file()), None)
    if found is None:
        raise FileFormatError(
            path,
            "it has no surface: the run did not finish, or ended with the depth (--until cloud); `epipole view` shows the depth of each image",
        )
    return read_mesh_ply(found)


def scene(path: Path) -> SpaceScene:
    """The textured mesh, else the mesh, else the cloud, else the model's points; the cameras; and the cloud, hidden if there is a mesh.

    Raises:
        FileFormatError: the folder has neither a surface nor depth, or a file is damaged.
    """
    depths, source = _depths(path), _model_source(path)
    main = None if depths and not any((path / name).is_file() for name in SURFACES) else read(path)
    mesh, words = _layer_of(main), list[str]()
    if mesh is not None:
        words.append(plural(len(mesh.faces), "triangle"))
        if isinstance(main, TexturedMesh):
            sizes = (f"{t.shape[1]} x {t.shape[0]}" for t in main.textures)
            words[0] += f" with a texture of {', '.join(sizes)} pixels"
    cloud = _cloud(path)
    points = () if cloud is None else (_sampled(cloud, is_shown=mesh is None),)
    if main is None and source is not None:
        points = (points_of_model(source.model),)
    words += [plural(len(layer.xyz_in_world), "point") for layer in points]
    cameras = _cameras(source, depths, is_shown=mesh is None)
    words += [] if cameras is None else [plural(len(cameras.names), "image")]
    rigs = None if source is None else rig_curve(source.model, is_shown=mesh is None)
    is_metric = source is not None and source.model.georeference is not None
    unit = METERS if is_metric else NO_UNIT
    return replace(
        SpaceScene(_title(path), ", ".join(words), unit, points, mesh=mesh),
        cameras=cameras,
        view=_first_view(path),
        curves=() if rigs is None or not len(rigs.segments_in_world) else (rigs,),
        upright_from_world=_upright(source),
        is_enu=is_metric,
    )


def _cloud(path: Path) -> PlyMesh | None:
    return read_mesh_ply(path / CLOUD) if (path / CLOUD).is_file() else None


def _layer_of(main: TexturedMesh | PlyMesh | None) -> TexturedMeshLayer | MeshLayer | None:
    if isinstance(main, TexturedMesh):
        return textured_layer("Textured mesh", main)
    if main is None or not len(main.faces):
        return None
    return MeshLayer("Mesh", main.xyz, main.faces, _colors(main))


def _sampled(cloud: PlyMesh, *, is_shown: bool) -> PointLayer:
    rows = shuffled(np.arange(len(cloud.xyz)), MOST_POINTS)
    return PointLayer("Dense cloud", cloud.xyz[rows], _colors(cloud)[rows], is_shown=is_shown)


def _colors(found: PlyMesh) -> np.ndarray:
    return found.rgb if found.rgb is not None else np.full((len(found.xyz), 3), GRAY, np.uint8)


def _title(path: Path) -> str:
    mark = read_mark(path)
    sources = mark.source.paths if mark is not None else ()
    return title_of(Path(sources[0])) if sources else path.resolve().name


def _model_source(path: Path) -> ModelSource | None:
    """The model of the surface; None if it no longer exists."""
    mark = read_mark(path)
    if mark is None or not mark.source.paths:
        return None
    source = Path(mark.source.paths[0])
    with suppress(EpipoleError):
        if (path / MODEL / "sparse" / "0").is_dir():
            photographs = source if source.is_dir() else path / MODEL / "images"
            return model_source_of(path / MODEL, IMAGE_PX, photographs)
        if source.exists() and is_model(source):
            return model_source_of(source, IMAGE_PX, _given_images(path))
    return None


def _given_images(path: Path) -> Path | None:
    """The folder of `--images`; None if it was not given."""
    with suppress(EpipoleError):
        config = read_json(path / "config.json")
        given = config.get("config", {}).get("images") if isinstance(config, dict) else None
        return Path(given) if isinstance(given, str) else None
    return None


def _depths(path: Path) -> dict[str, DepthView]:
    """The depth of each image by its name; empty without, as in folders of earlier versions."""
    if not (path / DEPTHS).is_file():
        return {}
    return {view.name: view for view in read_depth_views(path)}


def _cameras(
    source: ModelSource | None, depths: dict[str, DepthView], *, is_shown: bool
) -> CameraLayer | None:
    """The cameras of the model, else those of the depth, as pinhole cameras with their undistorted images and depth."""
    load_depth = partial(_depth_image, depths) if depths else None
    if source is not None and source.model.is_registered().any():
        cameras = [source.model.cameras[c] for c in range(len(source.model.cameras))]
        model = replace(source.model, cameras=Cameras.from_list(map(_pinhole, cameras)))
        images = ModelImages(source.model, source.folder, is_own=source.is_own)
        layer = cameras_of_model(model, CAMERAS, partial(_undistorted, images))
        return replace(layer, load_depth=load_depth, is_shown=is_shown)
    if not depths:
        return None
    pinholes = [view.camera for view in depths.values()]
    poses = Rigid3.from_matrix(np.array([view.cam_from_world.as_matrix() for view in depths.values()]))
    sizes = np.array([[camera.width, camera.height] for camera in pinholes], np.int64)
    K = np.array([camera.K for camera in pinholes])
    return CameraLayer(CAMERAS, tuple(depths), poses, K, sizes, load_depth=load_depth, is_shown=is_shown)


def _pinhole(camera: Camera) -> Camera:
    """The camera of the undistorted image; the camera itself if there is none."""
    with suppress(EpipoleError):
        return undistorted_camera(camera)
    return camera


def _undistorted(images: ModelImages, name: str) -> np.ndarray | None:
    """The image of `_pinhole`; None if it cannot be read."""
    with suppress(EpipoleError):
        image = images.find(name)
        rgb = image.read(IMAGE_PX)
        camera = image.camera.scaled_to(rgb.shape[1], rgb.shape[0])
        pinhole = _pinhole(camera)
        return rgb if pinhole is camera else undistort_image(rgb, camera, pinhole)
    return None


def _depth_image(depths: dict[str, DepthView], name: str) -> np.ndarray | None:
    """The depth of an image as colors; None without."""
    with suppress(EpipoleError):
        return color_map(depths[name].depth().depth) if name in depths else None
    return None


def _first_view(path: Path) -> FirstView | None:
    found = first_view_of_mesh(path / MESH) if (path / MESH).is_file() else None
    return FirstView(*found) if found is not None else None


def _upright(source: ModelSource | None) -> np.ndarray | None:
    """The rotation that makes the upward direction +z; None if it is."""
    if source is None or source.has_z_up:
        return None
    return Rotation3.from_two_vectors(
        up_in_world(source.model, source.has_z_up), np.array([0.0, 0.0, 1.0])
    ).matrix
