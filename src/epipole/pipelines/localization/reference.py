"""The model that images are localized in: its points, their descriptors, and a global descriptor of each image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from epipole._checks import Declared, checked
from epipole.cameras import Camera
from epipole.errors import FileFormatError, ShapeError
from epipole.features import Features, describe_image, describe_images, train_vocabulary
from epipole.io.colmap.database import read_database
from epipole.io.colmap.model import find_model, read_colmap_model
from epipole.io.workspaces import DATABASE, workspace_of_model
from epipole.mapping import PointViews
from epipole.scene import Reconstruction

WIDTH = 128
"""Bytes of a SIFT descriptor."""
SAME_FOCAL = 0.01
"""Relative difference of the focal lengths of a model's cameras up to which they count as one camera."""


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceModel(Declared):
    """A model with the SIFT descriptors of its observations, sorted by image."""

    model: Reconstruction
    views: PointViews
    descriptors: UInt8[np.ndarray, "k 128"]
    """Of each observation."""
    words: Float32[np.ndarray, "w 128"]
    """Visual words of the global descriptors."""
    image_descriptors: Float32[np.ndarray, "n v"]
    """Global descriptor of each image (VLAD of its observed points); zeros without points."""

    @staticmethod
    @checked
    def of(model: Reconstruction, descriptors: Sequence[UInt8[np.ndarray, "_ 128"]]) -> ReferenceModel:
        """Prepare a model for localization.

        Args:
            model: the model; its points are fixed.
            descriptors: SIFT descriptors of each image, one row per keypoint.

        Raises:
            ShapeError: their numbers differ from those of images and keypoints.
        """
        counts = np.diff(model.images.keypoint_offsets)
        if [len(d) for d in descriptors] != counts.tolist():
            raise ShapeError("descriptors must have one row per keypoint of each image")
        point, tracks = model.tracks.point_of_observation(), model.tracks
        used = np.flatnonzero(model.is_registered()[tracks.image])
        # Keypoints of other detectors have zeros.
        is_described = np.concatenate([np.zeros(0, bool), *(own.any(axis=1) for own in descriptors)])
        used = used[is_described[model.keypoint_rows()[used]]]
        views = PointViews.of(
            model.points.xyz_in_world,
            np.nan_to_num(model.camera_centers_in_world()),
            point[used].astype(np.int32),
            tracks.image[used],
            tracks.keypoint[used],
        )
        own = [descriptors[i][views.keypoint[views.rows_of(i)]] for i in range(len(model.images))]
        words = train_vocabulary(own)
        return ReferenceModel(
            model,
            views,
            np.concatenate([*own, np.zeros((0, WIDTH), np.uint8)]),
            words,
            describe_images(own, words),
        )

    @staticmethod
    @checked
    def open(workspace: str | Path) -> ReferenceModel:
        """Read a model and its descriptors from an output folder of `reconstruct`, or a COLMAP model beside its database.db.

        Raises:
            FileFormatError: there is no model or no database, or they do not belong to each other.
        """
        folder, root = find_model(workspace), workspace_of(workspace)
        model = read_colmap_model(folder)
        return ReferenceModel.of(model, _descriptors_of(model, root / DATABASE, folder))

    def camera_of_size(self, width: int, height: int) -> Camera | None:
        """The camera of the registered images of this size, if they share one."""
        model = self.model
        used = np.unique(model.camera_of_image[model.is_registered()]).tolist()
        cameras = [model.cameras[c] for c in used]
        return shared_camera([one for one in cameras if (one.width, one.height) == (width, height)])

    def most_similar(self, features: Features, count: int) -> Int64[np.ndarray, " c"]:
        """Images with the most similar global descriptors, best first."""
        similarity = self.image_descriptors @ describe_image(features.descriptors, self.words)
        return np.argsort(-similarity, kind="stable")[:count]

    def __repr__(self) -> str:
        return f"ReferenceModel({self.model!r})"


@checked
def workspace_of(path: str | Path) -> Path:
    """The folder with the database of a model, which also has the images: the given one, or a parent of the model's folder.

    Raises:
        FileFormatError: there is no model, or no database.
    """
    found = workspace_of_model(path, DATABASE)
    if found is None:
        raise FileFormatError(
            path, f"it has no {DATABASE} with descriptors, which localization needs besides the model"
        )
    return found


def shared_camera(cameras: Sequence[Camera]) -> Camera | None:
    """One camera for all; None if their focal lengths differ, or there is none."""
    if not cameras:
        return None
    focals = np.array([camera.focal_px for camera in cameras])
    return cameras[0] if focals.max() <= (1.0 + SAME_FOCAL) * focals.min() else None


def _descriptors_of(model: Reconstruction, database: Path, folder: Path) -> list[np.ndarray]:
    """Descriptors of the model's keypoints; zeros for images that are not registered or have none.

    Raises:
        FileFormatError: no image has any, or one has other keypoints than in the model.
    """
    stored = read_database(database, with_pairs=False)
    row_of = {name: row for row, name in enumerate(stored.images.name)}
    out = []
    for image, is_registered in enumerate(model.is_registered()):
        name, pixels = model.images.name[image], model.images.keypoints_of(image)
        if not is_registered:
            out.append(np.zeros((len(pixels), WIDTH), np.uint8))
            continue
        row = row_of.get(name)
        own = None if row is None or stored.descriptors is None else stored.descriptors[row]
        if row is None or own is None or own.shape[1] != WIDTH:
            out.append(np.zeros((len(pixels), WIDTH), np.uint8))
            continue
        there = stored.images.keypoints_of(row)
        if there.shape != pixels.shape or (len(pixels) and np.abs(there - pixels).max() > 0.01):
            raise FileFormatError(
                database,
                f"its keypoints of {name} are not those of the model {folder}: they come from different runs",
            )
        out.append(own)
    if not any(own.any() for own in out):
        raise FileFormatError(database, f"it has no SIFT descriptors of the images of the model {folder}")
    return out
