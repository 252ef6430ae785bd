"""Ground-truth cameras of benchmarks, in their published formats."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole._checks import checked
from epipole.errors import FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.io.colmap.model import read_colmap_model
from epipole.io.contents_in_words import what_it_is
from epipole.io.convert import is_model_file, read_model
from epipole.io.files import file_text
from epipole.scene import Reconstruction

_ROTATION_TOLERANCE = 1e-2
_FORMS = (
    "an output folder of `reconstruct`, a folder with a COLMAP model, with Strecha's .camera files or with a Middlebury *_par.txt file, "
    "a *_par.txt file, or a transforms.json or another program's cameras (OpenSfM, Metashape, RealityScan, Bundler, Nuke)"
)


@dataclass(frozen=True, slots=True, eq=False)
class TruthCameras:
    """Ground-truth poses of a benchmark's images."""

    names: tuple[str, ...]
    """Image names as given by the source."""
    cams_from_world: Rigid3

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        return f"TruthCameras({len(self)} cameras)"


@checked
def read_truth(path: str | Path) -> TruthCameras:
    """Read ground-truth cameras; the format is detected.

    Raises:
        FileFormatError: the path is in none of the supported formats, or damaged.
    """
    path = Path(path)
    if path.is_file():
        if path.name.endswith("_par.txt"):
            return _middlebury(path)
        if is_model_file(path):
            return _registered(read_model(path), path)
    if path.is_dir():
        if model := _model_in(path):
            return _registered(read_colmap_model(model), model)
        strecha = sorted(path.glob("*.camera"))
        if strecha:
            return _truth(
                [file.name.removesuffix(".camera") for file in strecha], [_strecha(f) for f in strecha]
            )
        lists = sorted(path.glob("*_par.txt"))
        if len(lists) == 1:
            return _middlebury(lists[0])
    problem = "not cameras in a supported format" if path.exists() else "it does not exist"
    what = what_it_is(path) if path.exists() else ""
    raise FileFormatError(path, "; ".join(filter(None, [problem, what, f"supported are {_FORMS}"])))


def is_truth_of_images(folder: Path) -> bool:
    """Whether a folder has cameras by image name, which `read_truth` reads, rather than a trajectory."""
    return _model_in(folder) is not None or any(
        next(folder.glob(pattern), None) is not None for pattern in ("*.camera", "*_par.txt")
    )


def _model_in(folder: Path) -> Path | None:
    """The COLMAP model that a folder is, or the first one of an output folder."""
    for model in (folder, folder / "sparse" / "0"):
        if any((model / f"cameras.{suffix}").is_file() for suffix in ("bin", "txt")):
            return model
    return None


def _truth(names: list[str], cams_from_world: list[Rigid3]) -> TruthCameras:
    rotation = np.array([motion.rotation for motion in cams_from_world]).reshape(-1, 3, 3)
    translation = np.array([motion.translation for motion in cams_from_world]).reshape(-1, 3)
    return TruthCameras(tuple(names), Rigid3(rotation, translation))


def _registered(reconstruction: Reconstruction, path: Path) -> TruthCameras:
    motions = reconstruction.cams_from_world()
    rows = np.flatnonzero(np.isfinite(motions.translation).all(axis=1))
    if len(rows) == 0:
        raise FileFormatError(path, "the model has no registered image")
    return TruthCameras(tuple(reconstruction.images.name[row] for row in rows), motions[rows])


def _numbers(path: Path, words: list[str], count: int, position: str) -> np.ndarray:
    try:
        values = np.array(words, np.float64)
    except ValueError as error:
        raise FileFormatError(path, f"{position}: {error}") from error
    if len(values) != count or not np.isfinite(values).all():
        raise FileFormatError(path, f"{position}: {count} finite numbers expected, got {len(values)}")
    return values


def _rotation(path: Path, matrix: np.ndarray, position: str) -> np.ndarray:
    """The nearest rotation: files store few digits."""
    nearest = Rotation3.nearest(matrix).matrix
    if np.abs(nearest - matrix).max() > _ROTATION_TOLERANCE:
        raise FileFormatError(path, f"{position}: not a rotation matrix")
    return nearest


def _strecha(path: Path) -> Rigid3:
    """K (3 lines), distortion, R world_from_cam (3 lines), center, size (Strecha et al., CVPR 2008)."""
    lines = [line.split() for line in file_text(path).splitlines() if line.strip()]
    if len(lines) != 9:
        raise FileFormatError(path, f"a .camera file has 9 lines, this one has {len(lines)}")
    world_from_cam = _numbers(path, lines[4] + lines[5] + lines[6], 9, "lines 5 to 7").reshape(3, 3)
    center = _numbers(path, lines[7], 3, "line 8")
    return Rigid3(_rotation(path, world_from_cam, "lines 5 to 7"), center).inverse()


def _middlebury(path: Path) -> TruthCameras:
    """Per line: name, K, R and t of P = K [R t] in row-major order (Seitz et al., CVPR 2006); line 1 is the count."""
    lines = [line.split() for line in file_text(path).splitlines() if line.strip()]
    names, motions = [], []
    for number, words in enumerate(lines[1:], 2):
        position = f"line {number}"
        values = _numbers(path, words[1:], 21, position)
        names.append(words[0])
        motions.append(Rigid3(_rotation(path, values[9:18].reshape(3, 3), position), values[18:]))
    if not names or lines[0] != [str(len(names))]:
        raise FileFormatError(path, f"line 1: the number of cameras is not {len(names)}")
    return _truth(names, motions)
