"""Poses of images that are known approximately: from a robot, a phone's tracking, another program or a survey.

A model is first mapped from its images alone, so that wrong poses cannot spoil it. Then it is moved to the coordinates of the poses that
agree with it, and adjusted with them as priors.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from epipole._checks import Declared
from epipole.errors import FileFormatError
from epipole.geometry import Rigid3, Rotation3, Similarity3
from epipole.io.convert import read_model
from epipole.io.files import read_json
from epipole.io.workspaces import workspace_of_model
from epipole.mapping import PosePriors
from epipole.robust import PairKind
from epipole.runs.earlier import SUMMARY
from epipole.scale import ScaleEstimate
from epipole.scene import ViewGraph

LEAST = 3
"""Poses that must agree with a model."""
LEAST_FRACTION = 0.5
"""Fraction of a model's known poses that must agree with it."""
OUTLIER = 5.0
"""Standard deviations from which a pose disagrees."""
LEAST_SPREAD = 5.0
"""Least extent of the positions, in standard deviations of one of them; below it, they do not determine the scale."""
MAX_TRIALS = 300
NUM_NAMED = 3
ROUNDS = 5


@dataclass(frozen=True, slots=True, eq=False)
class KnownPoses:
    """Known poses of some of the images."""

    cams_from_world: Rigid3
    """One row per image; NaN for those without a pose."""
    sigma_m: float
    """Standard deviation of each coordinate of a position, in the unit of the poses."""
    sigma_rad: float
    """Standard deviation of a rotation about each axis."""
    is_metric: bool = True
    """False if the poses are those of a model that is known to be up to scale."""

    def of(self, kept: Bool[np.ndarray, " n"]) -> KnownPoses:
        """The poses of the images of a mask."""
        return replace(self, cams_from_world=self.cams_from_world[kept])

    @property
    def is_known(self) -> Bool[np.ndarray, " n"]:
        """The images that have a pose."""
        return np.isfinite(self.cams_from_world.translation).all(axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class PoseFit(Declared):
    """How the known poses fit a model."""

    known_from_model: Similarity3
    kept: Bool[np.ndarray, " n"]
    """Images whose known pose agrees with the model."""
    position_m: Float64[np.ndarray, " n"]
    """Distance of each image from its known position; NaN without one."""
    rotation_rad: Float64[np.ndarray, " n"]
    """Angle to its known rotation."""

    def priors(self, known: KnownPoses) -> PosePriors:
        """The poses that agree, as priors of an adjustment."""
        translation = np.where(self.kept[:, None], known.cams_from_world.translation, np.nan)
        poses = Rigid3(known.cams_from_world.rotation, translation)
        return PosePriors(poses, known.sigma_m, known.sigma_rad)

    @property
    def num_kept(self) -> int:
        """Number of poses that agree."""
        return int(self.kept.sum())

    def scale(self, cams_from_world: Rigid3, known: KnownPoses) -> ScaleEstimate:
        """Scale of a model that was adjusted with the poses, with its standard deviation."""
        centers = cams_from_world[self.kept].centers()
        spread = float(np.sqrt(((centers - centers.mean(axis=0)) ** 2).sum()))
        each = max(known.sigma_m, float(np.sqrt(np.mean(self.position_m[self.kept] ** 2) / 3.0)))
        words = f"known poses of {self.num_kept} images"
        return ScaleEstimate("poses", "poses", 1.0, each / max(spread, 1e-9), 0.0, words)

    def summary(self, names: Sequence[str]) -> dict[str, Any]:
        """Numbers of `summary.json`."""
        is_compared = np.isfinite(self.position_m)
        return {
            "num_used": self.num_kept,
            "not_used": [names[i] for i in np.flatnonzero(is_compared & ~self.kept).tolist()],
            "median_position": float(np.median(self.position_m[self.kept])),
            "median_rotation_deg": float(np.degrees(np.median(self.rotation_rad[self.kept]))),
        }

    def after(self, cams_from_world: Rigid3, known: KnownPoses) -> PoseFit:
        """The same poses against an adjusted model, which is in their coordinates."""
        position_m, rotation_rad = _residuals(cams_from_world, known, Similarity3.identity())
        return replace(self, position_m=position_m, rotation_rad=rotation_rad)


def known_poses_of(path: Path, names: Sequence[str], sigma_m: float, sigma_deg: float) -> KnownPoses:
    """Read poses from a model of any format, and assign them to images by name, or by file name if that is unique.

    Raises:
        FileFormatError: the file is no model, or it has a pose for fewer than three of the images.
    """
    model = read_model(path)
    rows = np.flatnonzero(model.is_registered())
    by_name = {model.images.name[row]: int(row) for row in rows}
    counts = Counter(PurePosixPath(name).name for name in by_name)
    own = Counter(PurePosixPath(name).name for name in names)
    by_file = {PurePosixPath(name).name: row for name, row in by_name.items()}
    poses = model.cams_from_world()
    rotation, translation = np.tile(np.eye(3), (len(names), 1, 1)), np.full((len(names), 3), np.nan)
    for image, name in enumerate(names):
        file = PurePosixPath(name).name
        is_unique = counts[file] == 1 and own[file] == 1
        row = by_name.get(name, by_file.get(file) if is_unique else None)
        if row is not None:
            rotation[image], translation[image] = poses.rotation[row], poses.translation[row]
    sigma_rad, is_metric = float(np.deg2rad(sigma_deg)), not _is_up_to_scale(path)
    known = KnownPoses(Rigid3(rotation, translation), sigma_m, sigma_rad, is_metric)
    if known.is_known.sum() < LEAST:
        shown = ", ".join(list(by_name)[:3])
        raise FileFormatError(
            path,
            f"it has a pose for {known.is_known.sum()} of the {len(names)} images, and at least {LEAST} are needed; its images"
            f" are {shown}{', ...' if len(by_name) > LEAST else ''}",
        )
    return known


def _is_up_to_scale(path: Path) -> bool:
    """Whether the summary of the output folder that a model belongs to says so."""
    try:
        folder = path if path.is_file() else workspace_of_model(path, SUMMARY)
        summary = {} if folder is None or folder.is_file() else read_json(folder / SUMMARY)
    except FileFormatError:
        return False
    return isinstance(summary, dict) and summary.get("is_metric") is False


def fit_known_poses(cams_from_model: Rigid3, known: KnownPoses, seed: int) -> PoseFit | None:
    """The similarity to the poses that agree best with a model; None if too few do, or if they do not determine the scale.

    Three poses give a similarity: over large scenes from their positions, which then determine the rotation better than their rotations do.
    That with most poses within their errors is refined over those (Fischler and Bolles 1981).

    Args:
        cams_from_model: (n) poses of the model's images, NaN rows for images that it does not have.
        known: the poses.
        seed: seed of the choice of triples.
    """
    rows = np.flatnonzero(np.isfinite(cams_from_model.translation).all(axis=1) & known.is_known)
    if len(rows) < LEAST:
        return None
    mine, theirs = cams_from_model[rows], known.cams_from_world[rows]
    best, most = None, 0
    for three in _triples(len(rows), seed):
        found = _similarity(mine[three], theirs[three], known)
        if found is not None and (count := int(_agrees(cams_from_model, known, found).sum())) > most:
            best, most = found, count
            if most == len(rows):
                break
    if best is None or most < max(LEAST, LEAST_FRACTION * len(rows)):
        return None
    for _ in range(ROUNDS):
        kept = _agrees(cams_from_model, known, best)
        if kept.sum() < max(LEAST, LEAST_FRACTION * len(rows)):
            return None
        refined = _similarity(cams_from_model[kept], known.cams_from_world[kept], known)
        if refined is None:
            return None
        best = refined
    kept = _agrees(cams_from_model, known, best)
    position_m, rotation_rad = _residuals(cams_from_model, known, best)
    return PoseFit(best, kept, position_m, rotation_rad)


def _triples(count: int, seed: int) -> list[np.ndarray]:
    """All sets of three rows, or a random sample of them."""
    if math.comb(count, 3) <= MAX_TRIALS:
        return [np.array(three) for three in combinations(range(count), 3)]
    rng = np.random.default_rng(seed)
    return [rng.choice(count, 3, replace=False) for _ in range(MAX_TRIALS)]


def _similarity(mine: Rigid3, theirs: Rigid3, known: KnownPoses) -> Similarity3 | None:
    """Least squares over positions and rotations, weighted by their standard deviations.

    The rotation maximizes trace(R M) for the sum M of both kinds of evidence (Wahba 1965), with centered positions in the scale
    of the previous solution.
    """
    source, target = mine.centers(), theirs.centers()
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    scale = np.sqrt((b**2).sum() / max((a**2).sum(), 1e-300))
    # |b - s R a|^2 and the squared angle, which is 3 - tr(R^T theirs^T mine) for small ones, leave these terms linear in R.
    evidence = 2.0 * scale * (b.T @ a) / known.sigma_m**2
    evidence += np.einsum("nji,njk->ik", theirs.rotation, mine.rotation) / known.sigma_rad**2
    return _scaled(Rotation3.nearest(evidence).matrix, source, target, known)


def _scaled(
    rotation: np.ndarray, source: np.ndarray, target: np.ndarray, known: KnownPoses
) -> Similarity3 | None:
    """With a known rotation, least-squares scale and translation; None if the positions do not determine the scale."""
    a, b = (source - source.mean(axis=0)) @ rotation.T, target - target.mean(axis=0)
    along, spread = float((a * b).sum()), float((a**2).sum())
    if spread <= 0 or along <= 0 or np.sqrt((b**2).sum()) < LEAST_SPREAD * known.sigma_m:
        return None
    scale = along / spread
    return Similarity3(
        np.asarray(scale), rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0)
    )


def _residuals(
    cams_from_model: Rigid3, known: KnownPoses, known_from_model: Similarity3
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Distances and angles between the known poses and the model's; NaN where one is unknown."""
    n = len(known.is_known)
    position, angle = np.full(n, np.nan), np.full(n, np.nan)
    rows = np.flatnonzero(np.isfinite(cams_from_model.translation).all(axis=1) & known.is_known)
    moved = known_from_model.move_cam_from_source(cams_from_model[rows])
    theirs = known.cams_from_world[rows]
    position[rows] = np.linalg.norm(moved.centers() - theirs.centers(), axis=1)
    angle[rows] = Rotation3(moved.rotation @ np.swapaxes(theirs.rotation, 1, 2)).angle_rad()
    return position, angle


def _agrees(
    cams_from_model: Rigid3, known: KnownPoses, known_from_model: Similarity3
) -> Bool[np.ndarray, " n"]:
    position, angle = _residuals(cams_from_model, known, known_from_model)
    with np.errstate(invalid="ignore"):
        return (position <= OUTLIER * known.sigma_m) & (angle <= OUTLIER * known.sigma_rad)


def contradiction_with_poses(
    view_graph: ViewGraph, known: KnownPoses | None, limit_rad: float
) -> Float64[np.ndarray, " e"]:
    """Angles of the pairs whose rotation differs from that of their known poses by more than a limit and the errors of the poses, else NaN.

    The pose of an image that contradicts more of its pairs than it confirms is not trusted.
    """
    out = np.full(len(view_graph), np.nan)
    if known is None:
        return out
    i, j = view_graph.image1, view_graph.image2
    is_known = known.is_known
    has_motion = ~np.isin(view_graph.kind, (PairKind.UNCALIBRATED, PairKind.NO_MOTION))
    rows = np.flatnonzero(has_motion & is_known[i] & is_known[j])
    rotation = known.cams_from_world.rotation
    expected = rotation[j[rows]] @ np.swapaxes(rotation[i[rows]], 1, 2)
    angle = Rotation3(view_graph.cam2_from_cam1.rotation[rows] @ np.swapaxes(expected, 1, 2)).angle_rad()
    is_off = angle > limit_rad + OUTLIER * np.sqrt(2.0) * known.sigma_rad
    votes = np.zeros(len(is_known), np.int64)
    for ends in (i, j):
        np.add.at(votes, ends[rows], np.where(is_off, -1, 1))
    is_wrong = is_off & (votes[i[rows]] > 0) & (votes[j[rows]] > 0)
    out[rows[is_wrong]] = angle[is_wrong]
    return out


def notes_on_poses(
    names: Sequence[str], known: KnownPoses | None, fit: PoseFit | None, is_registered: Bool[np.ndarray, " n"]
) -> list[str]:
    """Warnings if the known poses do not fit the largest model, or if some of them contradict it."""
    if known is None:
        return []
    if fit is None:
        count = int((known.is_known & is_registered).sum())
        return [
            f"the known poses are not used: too few of the {count} of images in the model agree with it within {OUTLIER:g} standard"
            f" deviations ({known.sigma_m:g} m, {np.degrees(known.sigma_rad):g} degrees), or their positions are too near each other"
            " to determine the scale; check the directions of their axes, or pass larger standard deviations"
            " (known_poses_sigma_m, known_poses_sigma_deg)"
        ]
    out = []
    if not known.is_metric:
        out.append("the known poses are those of a model up to scale, and so is this one")
    far = np.flatnonzero(np.isfinite(fit.position_m) & ~fit.kept)
    if not len(far):
        return out
    unit = " m" if known.is_metric else ""
    far = far[np.argsort(-fit.position_m[far], kind="stable")]
    named = ", ".join(
        f"{names[i]} by {fit.position_m[i]:.3g}{unit} and {np.degrees(fit.rotation_rad[i]):.3g} degrees"
        for i in far[:NUM_NAMED]
    )
    more = f" and {len(far) - NUM_NAMED} more" if len(far) > NUM_NAMED else ""
    return [*out, f"known poses that contradict the model are not used: {named}{more}"]
