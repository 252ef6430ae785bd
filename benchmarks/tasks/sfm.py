"""Structure-from-motion sets: images, known calibration, and ground truth."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True, slots=True)
class SfmTask:
    """One set of photographs. Camera parameters use COLMAP's pixel coordinates: the image's corner is (0, 0)."""

    name: str
    images: Path
    image_names: tuple[str, ...]
    known: str
    """Description of what each program is given besides the images."""
    camera_model: str | None = None
    camera_params: tuple[float, ...] | None = None
    """Fixed intrinsics; None: each program estimates them."""
    truth: Path | None = None
    unit: str = ""
    """Unit of length of the ground truth."""
    has_gps: bool = False


def data_root(requested: Path | None = None) -> Path:
    """The data folder: `requested`, `$EPIPOLE_DATA`, or ../shared/data next to the repository."""
    default = Path(__file__).resolve().parents[3] / "shared" / "data"
    return requested or Path(os.environ.get("EPIPOLE_DATA", default))


def prepare(name: str, data: Path, work: Path) -> SfmTask:
    """The task of this name; copies of images go under `work`.

    Raises:
        FileNotFoundError: the data folder does not have the set.
        KeyError: there is no set of this name.
    """
    folder = data / ("slam" if name in SEQUENCES else "sfm")
    if not folder.is_dir():
        raise FileNotFoundError(
            f"There is no folder {folder}: pass the data folder with --data or $EPIPOLE_DATA."
        )
    return SETS[name](folder, work)


def strip_exif(jpeg: bytes) -> bytes:
    """Remove application and comment segments of a JPEG file, except JFIF's and Adobe's, without decoding it.

    Raises:
        ValueError: the bytes are not a JPEG file.
    """
    if jpeg[:2] != b"\xff\xd8":
        raise ValueError("The bytes are not a JPEG file.")
    kept, position = [jpeg[:2]], 2
    while jpeg[position + 1] != 0xDA:  # start of scan, where the compressed image begins
        marker, length = jpeg[position + 1], int.from_bytes(jpeg[position + 2 : position + 4], "big")
        if not (0xE1 <= marker <= 0xEF and marker != 0xEE) and marker != 0xFE:
            kept.append(jpeg[position : position + 2 + length])
        position += 2 + length
    return b"".join([*kept, jpeg[position:]])


def _images_in(folder: Path) -> tuple[str, ...]:
    names = tuple(sorted(p.name for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES))
    if not names:
        raise FileNotFoundError(f"There are no images in {folder}.")
    return names


def _pinhole(K: np.ndarray) -> tuple[float, float, float, float]:
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def _strecha(name: str) -> Callable[[Path, Path], SfmTask]:
    """A set of Strecha et al. (CVPR 2008) with its calibration; in K.txt, the image's corner is (0, 0)."""

    def make(folder: Path, _work: Path) -> SfmTask:
        images = folder / name / "images"
        names = _images_in(images)
        params = _pinhole(np.loadtxt(images / "K.txt"))
        truth = folder / name / "gt_dense_cameras"
        return SfmTask(name, images, names, "calibration", "PINHOLE", params, truth, "m")

    return make


def _fountain_unknown(folder: Path, work: Path) -> SfmTask:
    """fountain-P11 without calibration file and without EXIF."""
    source = folder / "fountain-P11"
    images = work / "fountain-P11-unknown"
    images.mkdir(parents=True, exist_ok=True)
    names = _images_in(source / "images")
    for name in names:
        (images / name).write_bytes(strip_exif((source / "images" / name).read_bytes()))
    truth = source / "gt_dense_cameras"
    return SfmTask("fountain-P11-unknown", images, names, "nothing", truth=truth, unit="m")


def _temple_ring(folder: Path, _work: Path) -> SfmTask:
    """Middlebury's temple ring. Its K has pixel centers at integers, so COLMAP's principal point is 0.5 larger."""
    images = folder / "temple_ring"
    truth = images / "templeR_par.txt"
    row = truth.read_text().splitlines()[1].split()
    fx, fy, cx, cy = _pinhole(np.array(row[1:10], np.float64).reshape(3, 3))
    params = (fx, fy, cx + 0.5, cy + 0.5)
    return SfmTask("temple_ring", images, _images_in(images), "calibration", "PINHOLE", params, truth, "m")


def _without_truth(
    name: str, inside: str, known: str, *, has_gps: bool = False
) -> Callable[[Path, Path], SfmTask]:
    def make(folder: Path, _work: Path) -> SfmTask:
        images = folder / name / inside
        return SfmTask(name, images, _images_in(images), known, has_gps=has_gps)

    return make


def _kitti00(folder: Path, work: Path) -> SfmTask:
    """Fifty grayscale frames of a car driving forward (KITTI odometry 00, left camera)."""
    source = folder / "kitti00_mono"
    world_from_cam = np.loadtxt(source / "poses.txt").reshape(-1, 3, 4)
    frames = [(source / f"{k:06d}.png", pose) for k, pose in enumerate(world_from_cam)]
    fx, fy, cx, cy = map(float, np.loadtxt(source / "intrinsics.txt").ravel()[:4])
    return of_frames("kitti00", [f for f in frames if f[0].is_file()], (fx, fy, cx + 0.5, cy + 0.5), work)


def _kitchen(folder: Path, work: Path) -> SfmTask:
    """Every eighth frame of a hand-held RGB-D sequence (7-Scenes), with ground truth accurate to about a centimeter."""
    source = folder / "7scenes"
    images = sorted(source.glob("frame-*.color.jpg"))[::8]
    frames = [(p, np.loadtxt(str(p).replace(".color.jpg", ".pose.txt"))[:3]) for p in images]
    return of_frames("kitchen", frames, (585.0, 585.0, 320.0, 240.0), work)


def _kitchen_all(folder: Path, work: Path) -> SfmTask:
    """All 325 frames at hand of the same sequence, with the color camera's focal length."""
    source = folder / "7scenes"
    rows = np.loadtxt(source / "poses_sfm.txt")
    frames = [(source / f"frame-{int(row[0]):06d}.color.jpg", matrix_of(row[1:8])) for row in rows]
    frames = [frame for frame in frames if frame[0].is_file()]
    return of_frames("kitchen-all", frames, (525.5, 525.5, 320.5, 240.5), work)


def _kitchen_start(folder: Path, work: Path) -> SfmTask:
    """The first 125 frames at hand of the same sequence, with the color camera's focal length, and with depth images."""
    source = folder / "7scenes"
    images = sorted(source.glob("frame-*.color.jpg"))[:125]
    rows = np.loadtxt(source / "poses_sfm.txt")
    pose_of = {round(row[0]): matrix_of(row[1:8]) for row in rows}
    frames = [(p, pose_of[int(p.name[6:12])]) for p in images]
    return of_frames("kitchen-start", frames, (525.5, 525.5, 320.5, 240.5), work)


def matrix_of(pose: np.ndarray) -> np.ndarray:
    """(3, 4) of a row (x, y, z, qx, qy, qz, qw)."""
    rotation = Rotation.from_quat(pose[3:]).as_matrix()
    return np.column_stack([rotation, pose[:3]])


def of_frames(
    name: str, frames: list[tuple[Path, np.ndarray]], params: tuple[float, ...], work: Path
) -> SfmTask:
    """A task of frames with known K and poses (world_from_cam, 3 x 4); image links and truth go under `work`."""
    images = work / name
    images.mkdir(parents=True, exist_ok=True)
    lines = [str(len(frames))]
    for image, pose in frames:
        link = images / image.name
        if not link.exists():
            link.symlink_to(image.resolve())
        rotation, center = pose[:, :3], pose[:, 3]
        numbers = [*np.eye(3).ravel(), *rotation.T.ravel(), *(-rotation.T @ center)]
        lines.append(" ".join([image.name, *(f"{value:.12g}" for value in numbers)]))
    truth = work / f"{name}_par.txt"
    truth.write_text("\n".join(lines) + "\n", encoding="utf-8")
    names = tuple(image.name for image, _ in frames)
    return SfmTask(name, images, names, "calibration", "PINHOLE", params, truth, "m")


SETS: dict[str, Callable[[Path, Path], SfmTask]] = {
    "fountain-P11": _strecha("fountain-P11"),
    "Herz-Jesus-P8": _strecha("Herz-Jesus-P8"),
    "castle-P19": _strecha("castle-P19"),
    "fountain-P11-unknown": _fountain_unknown,
    "sceaux_castle": _without_truth("sceaux_castle", "images", "EXIF"),
    "sacre_coeur": _without_truth("sacre_coeur", "mapping", "EXIF where there is any"),
    "lund_gps": _without_truth("lund_gps", "images", "EXIF", has_gps=True),
    "temple_ring": _temple_ring,
    "kitti00": _kitti00,
    "kitchen": _kitchen,
    "kitchen-start": _kitchen_start,
    "kitchen-all": _kitchen_all,
}
SEQUENCES = ("kitti00", "kitchen", "kitchen-start", "kitchen-all")
"""Sets from the sequences of the SLAM data."""
