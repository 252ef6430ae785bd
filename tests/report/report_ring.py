"""A small model with known answers: a ring of cameras around a colored ball of points."""

import io

import numpy as np
from PIL import Image

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3
from epipole.pipelines.sfm.page.content import ContradictingPair, ImageRow, ReportContent
from epipole.robust import PairKind
from epipole.scene import (
    Cameras,
    Frames,
    Images,
    Points,
    Reconstruction,
    Rigs,
    Tracks,
    ViewGraph,
    unregistered,
)

WIDTH, HEIGHT, FOCAL_PX = 640, 480, 520.0
HOSTILE = "<script>alert('x')</script>\"&\u202e.jpg"


def looking_at_origin(centers: np.ndarray) -> Rigid3:
    """Cameras at these places that look at the origin with +z of the world upwards in the image."""
    forward = -centers / np.linalg.norm(centers, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    return Rigid3(rotation, -(rotation @ centers[:, :, None])[:, :, 0])


def ring_model(
    num_images: int = 12, num_points: int = 400, noise_px: float = 0.4, num_absent: int = 2, seed: int = 3
) -> Reconstruction:
    """The last `num_absent` images have no place; every other image sees about two thirds of the points."""
    rng = np.random.default_rng(seed)
    num_registered = num_images - num_absent
    camera = Camera(CameraModel.PINHOLE, WIDTH, HEIGHT, np.array([FOCAL_PX, FOCAL_PX, 319.5, 239.5]))
    angle = 2 * np.pi * np.arange(num_registered) / max(num_registered, 1)
    centers = np.stack([4 * np.cos(angle), 4 * np.sin(angle), 1 + 0.4 * np.sin(2 * angle)], axis=1)
    cams_from_world = looking_at_origin(centers)
    xyz = rng.normal(size=(num_points, 3))
    xyz *= (0.6 + 0.4 * rng.random((num_points, 1))) / np.linalg.norm(xyz, axis=1, keepdims=True)
    seen = rng.random((num_registered, num_points)) < 2 / 3
    seen &= seen.sum(axis=0) >= 2
    pixels = [camera.project(cams_from_world[i].apply(xyz[seen[i]])) for i in range(num_registered)]
    pixels = [p + noise_px * rng.normal(size=p.shape) for p in pixels]
    absent = [rng.random((30, 2)) * (WIDTH, HEIGHT) for _ in range(num_absent)]
    offsets = np.cumsum([0, *map(len, [*pixels, *absent])])
    point, image = np.nonzero(seen.T)
    keypoint = (np.cumsum(seen, axis=1) - 1)[image, point]
    lost = unregistered(num_absent)
    return Reconstruction(
        Cameras.from_list([camera]),
        Rigs.of_single_cameras(1),
        Frames(
            np.zeros(num_images, np.int32),
            Rigid3(
                np.concatenate([cams_from_world.rotation, lost.rotation]),
                np.concatenate([cams_from_world.translation, lost.translation]),
            ),
            np.full(num_images, np.nan),
        ),
        Images(
            tuple(f"ring/picture_{i:03d}.jpg" for i in range(num_images)),
            np.arange(num_images, dtype=np.int32),
            np.zeros(num_images, np.int32),
            offsets.astype(np.int64),
            np.concatenate([*pixels, *absent]) if num_images else np.zeros((0, 2)),
        ),
        Points(xyz, (127.5 + 110 * xyz).astype(np.uint8), np.full(num_points, noise_px)),
        Tracks(
            np.concatenate([[0], np.cumsum(seen.sum(axis=0))]).astype(np.int64),
            image.astype(np.int32),
            keypoint.astype(np.int32),
        ),
    )


def empty_model(num_images: int) -> Reconstruction:
    """Images without a place, and no points."""
    return ring_model(num_images, num_points=0, num_absent=num_images)


def graph_of(model: Reconstruction) -> ViewGraph:
    """Pairs of placed images up to four steps apart on the ring, with made-up counts."""
    registered = np.flatnonzero(model.is_registered())
    pairs = [(a, b) for a in registered for b in registered if a < b <= a + 4]
    n, counts = len(pairs), np.array([300 // (b - a) ** 2 for a, b in pairs], np.int64)
    first, second = np.array(pairs, np.int32).reshape(n, 2).T.copy()
    total = int(counts.sum())
    return ViewGraph(
        first,
        second,
        np.where(np.arange(n) % 5 == 0, PairKind.PLANAR, PairKind.GENERAL).astype(np.int32),
        (counts + 50).astype(np.int32),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        np.zeros(total, np.int32),
        np.zeros(total, np.int32),
        unregistered(n),
        *(np.full((n, 3, 3), np.nan) for _ in range(3)),
        np.where(np.arange(n) % 7 == 3, np.nan, np.deg2rad(1.0 + np.arange(n))),
    )


def rows_of(model: Reconstruction) -> tuple[ImageRow, ...]:
    """The table's rows, as a caller gathers them."""
    errors, registered = model.reprojection_errors_px(), model.is_registered()
    rows = []
    for i, name in enumerate(model.images.name):
        mine = errors[model.tracks.image == i]
        rows.append(
            ImageRow(
                name=name,
                is_registered=bool(registered[i]),
                component=0 if registered[i] else -1,
                num_keypoints=len(model.images.keypoints_of(i)),
                num_observations=len(mine),
                mean_error_px=float(mine.mean()) if len(mine) else float("nan"),
                reason="" if registered[i] else "too few matches with any placed image (7, needed 15)",
            )
        )
    return tuple(rows)


def jpeg_of(model: Reconstruction, image: int, width: int = 320) -> bytes:
    """A thumbnail: a soft gradient, differently tinted for each image."""
    height = width * HEIGHT // WIDTH
    y, x = np.mgrid[0:height, 0:width]
    tint = 90 + 60 * np.cos(image + np.array([0.0, 2.0, 4.0]))
    picture = tint + 50 * np.sin(x / 37 + image)[..., None] + 40 * np.cos(y / 23)[..., None]
    stream = io.BytesIO()
    Image.fromarray(np.clip(picture, 0, 255).astype(np.uint8)).save(stream, "JPEG", quality=80)
    return stream.getvalue()


def contradicting_of(model: Reconstruction) -> tuple[ContradictingPair, ...]:
    """Fourteen pairs that look alike, the one with the most matches first."""
    rng = np.random.default_rng(7)
    names = model.images.name
    if len(names) < 2:
        return ()
    return tuple(
        ContradictingPair(
            (names[0], names[1 + k % (len(names) - 1)]),
            (rng.uniform(size=(40 - k, 2)), rng.uniform(size=(40 - k, 2))),
            40 - k,
            f"rotation off by {20 + 10 * k}°",
        )
        for k in range(14)
    )


def content_of(model: Reconstruction, title: str = "Ring around a ball") -> ReportContent:
    """Everything that a report can show, for this model."""
    observed, images = model.observed_pixels(), range(len(model.images))
    fractions = {
        model.images.name[i]: (observed[model.tracks.image == i] + 0.5) / (WIDTH, HEIGHT) for i in images
    }
    return ReportContent(
        title=title,
        reconstruction=model,
        view_graph=graph_of(model),
        image_rows=rows_of(model),
        contradicting=contradicting_of(model),
        camera_lines=tuple(repr(model.cameras[c]) for c in range(len(model.cameras))),
        timings={"features": 12.34, "matching": 30.5, "mapping": 71.0, "writing": 0.04},
        compile_seconds=8.2,
        settings={"features": {"max_keypoints": 8000, "detector": "sift"}, "seed": 0},
        thumbnails={model.images.name[i]: jpeg_of(model, i) for i in images},
        inliers=fractions,
    )
