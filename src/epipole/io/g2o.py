"""Pose graphs in g2o's text format: SE(2), SE(3) and Sim(3).

Information matrices of 3D edges refer to (translation, rotation vector), as in GTSAM; g2o itself uses the imaginary
part of a quaternion, which is half the rotation vector.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Int64

from epipole._checks import as_path, checked
from epipole._checks.arrays import as_array
from epipole.errors import FileFormatError, ShapeError
from epipole.geometry import Rigid2, Rigid3, Rotation3, Similarity3
from epipole.io.atomic import atomic_write
from epipole.io.files import file_bytes
from epipole.optim import PoseGraph
from epipole.optim.pose_graph import not_definite

_KINDS = {"SE2": (3, 3), "SE3:QUAT": (7, 6), "SIM3:QUAT": (8, 7)}
"""Length of a motion's row in the file, and dimension of its tangent space."""
_IGNORED = ("PARAMS_", "#")
"""Parameters belong to edges of unsupported kinds, which are rejected."""
_FEW = 5
_LEAST_FRACTION = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class G2oFile:
    """A pose graph and its vertex names in the file."""

    graph: PoseGraph
    ids: Int64[np.ndarray, " n"]
    """Ascending."""
    mended_edges: Int64[np.ndarray, " e"]
    """Edges whose information matrices were not positive definite and were replaced."""

    def __repr__(self) -> str:
        return f"G2oFile({self.graph!r})"


@checked
def read_g2o(path: str | Path, *, indefinite: Literal["refuse", "nearest"] = "refuse") -> G2oFile:
    """Read vertices and edges of one kind, and which vertices are fixed; parameters and comments are ignored.

    Args:
        path: the file.
        indefinite: how to treat edges whose information matrices are not positive definite. "refuse": raise an error
            that lists them. "nearest": replace the matrix with the nearest one whose eigenvalues are at least 1e-9 of
            the largest (Higham, Linear Algebra Appl. 1988); `mended_edges` lists them.

    Raises:
        FileFormatError: the file is unreadable, mixes kinds, refers to a missing vertex, or has a malformed line or an
            invalid information matrix; the message names the line or the edges.
    """
    path = as_path(path)
    lines = file_bytes(path).decode("utf-8", "replace").splitlines()
    kind: str | None = None
    vertices: dict[int, list[float]] = {}
    edges: list[tuple[int, int]] = []
    values: list[list[float]] = []
    fixed: dict[int, int] = {}
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith(_IGNORED):
            continue
        if words[0] == "FIX":
            fixed |= dict.fromkeys(_fixed_names(path, number, words[1:]), number)
            continue
        what, _, this = words[0].partition("_")
        if what not in ("VERTEX", "EDGE") or this not in _KINDS:
            raise FileFormatError(path, f"line {number}: {words[0]} is not a supported kind")
        if kind not in (None, this):
            raise FileFormatError(path, f"line {number}: {this} in a graph of {kind}")
        kind = this
        size, tangent = _KINDS[this]
        names, wanted = (1, size) if what == "VERTEX" else (2, size + tangent * (tangent + 1) // 2)
        try:
            index = [int(w) for w in words[1 : 1 + names]]
            numbers = [float(w) for w in words[1 + names :]]
        except ValueError as error:
            raise FileFormatError(path, f"line {number}: {error}") from error
        if len(numbers) != wanted or len(index) != names or not np.isfinite(numbers).all():
            raise FileFormatError(path, f"line {number}: expected {wanted} finite numbers after the names")
        _require_names(path, number, index)
        if not _is_motion(numbers[:size]):
            raise FileFormatError(
                path, f"line {number}: {words[0]} has no valid quaternion or no positive scale"
            )
        if what == "VERTEX":
            if index[0] in vertices:
                raise FileFormatError(path, f"line {number}: vertex {index[0]} is defined twice")
            vertices[index[0]] = numbers
        else:
            edges.append((index[0], index[1]))
            values.append(numbers)
    if kind is None or not vertices:
        raise FileFormatError(path, "no vertices: not a pose graph")
    return _with_fixed(path, _assemble(path, kind, vertices, edges, values, indefinite), fixed)


def _with_fixed(path: Path, found: G2oFile, fixed: dict[int, int]) -> G2oFile:
    known = set(found.ids.tolist())
    for name, number in fixed.items():
        if name not in known:
            raise FileFormatError(path, f"line {number}: FIX names vertex {name}, which is not defined")
    rows = np.searchsorted(found.ids, np.array(sorted(fixed), np.int64)).astype(np.int64)
    return replace(found, graph=replace(found.graph, fixed=rows))


def _fixed_names(path: Path, number: int, words: list[str]) -> list[int]:
    try:
        names = [int(word) for word in words]
    except ValueError as error:
        raise FileFormatError(path, f"line {number}: {error}") from error
    if not names:
        raise FileFormatError(path, f"line {number}: FIX names no vertex")
    _require_names(path, number, names)
    return names


def _require_names(path: Path, number: int, names: list[int]) -> None:
    if not all(-(2**63) <= name < 2**63 for name in names):
        raise FileFormatError(path, f"line {number}: a vertex name must fit in 64 bits")


@checked
def write_g2o(path: str | Path, graph: PoseGraph, ids: Any = None) -> None:
    """Write a pose graph; vertices are numbered from zero unless `ids` names them.

    Raises:
        ShapeError: `ids` is not one integer per vertex.
        WorkspaceError: the file cannot be written.
    """
    name = {Rigid2: "SE2", Rigid3: "SE3:QUAT", Similarity3: "SIM3:QUAT"}[type(graph.world_from_body)]
    names = np.arange(len(graph)) if ids is None else as_array(ids, "ids", np.dtype(np.int64))
    if names.shape != (len(graph),):
        raise ShapeError(f"ids must be ({len(graph)},), got {names.shape}")
    upper = np.triu_indices(graph.dimension)
    positions, measured = _numbers(graph.world_from_body), _numbers(graph.first_from_second)
    lines = [f"VERTEX_{name} {i} {_text(row)}" for i, row in zip(names, positions)]
    lines += [f"FIX {names[row]}" for row in graph.fixed]
    information = graph.information[:, upper[0], upper[1]]
    for i, j, row, weights in zip(names[graph.first], names[graph.second], measured, information):
        lines.append(f"EDGE_{name} {i} {j} {_text(row)} {_text(weights)}")
    with atomic_write(as_path(path)) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _assemble(
    path: Path,
    kind: str,
    vertices: dict[int, list[float]],
    edges: list[tuple[int, int]],
    values: list[list[float]],
    indefinite: str,
) -> G2oFile:
    size, tangent = _KINDS[kind]
    ids = np.array(sorted(vertices), np.int64)
    row = {int(name): k for k, name in enumerate(ids)}
    missing = [name for edge in edges for name in edge if name not in row]
    if missing:
        raise FileFormatError(path, f"an edge names vertex {missing[0]}, which is not defined")
    positions = np.array([vertices[int(name)] for name in ids])
    numbers = np.array(values).reshape(len(edges), size + tangent * (tangent + 1) // 2)
    information = np.zeros((len(edges), tangent, tangent))
    upper = np.triu_indices(tangent)
    information[:, upper[0], upper[1]] = numbers[:, size:]
    information[:, upper[1], upper[0]] = numbers[:, size:]
    mended = not_definite(information)
    if len(mended) and indefinite == "refuse":
        raise FileFormatError(path, _refusal(mended, edges))
    information[mended] = _nearest_definite(path, information[mended])
    index = np.array([[row[i], row[j]] for i, j in edges], np.int64).reshape(-1, 2)
    graph = PoseGraph(
        _motions(kind, positions),
        index[:, 0].copy(),
        index[:, 1].copy(),
        _motions(kind, numbers[:, :size]),
        information,
    )
    return G2oFile(graph, ids, mended)


def _refusal(mended: np.ndarray, edges: list[tuple[int, int]]) -> str:
    few = ", ".join("{} {}".format(*edges[k]) for k in mended[:_FEW])
    more = f" and {len(mended) - _FEW} more" if len(mended) > _FEW else ""
    return (
        f"the information matrices of {len(mended)} of {len(edges)} edges are not positive definite: {few}{more}; "
        'read_g2o(..., indefinite="nearest") replaces them with the nearest ones that are'
    )


def _nearest_definite(path: Path, information: np.ndarray) -> np.ndarray:
    """The nearest symmetric matrices (n, d, d) with eigenvalues of at least 1e-9 of the largest."""
    values, vectors = np.linalg.eigh(information)
    if not (values[:, -1:] > 0).all():
        raise FileFormatError(path, "an edge's information matrix has no positive eigenvalue")
    raised = np.maximum(values, _LEAST_FRACTION * values[:, -1:])
    out = (vectors * raised[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return 0.5 * (out + np.swapaxes(out, 1, 2))


def _is_motion(numbers: list[float]) -> bool:
    """Whether a row is a valid motion: a quaternion of reasonable length, a positive scale."""
    longest = max((abs(part) for part in numbers[3:7]), default=1.0)
    return 1e-6 < longest < 1e6 and all(scale > 0 for scale in numbers[7:])


def _motions(kind: str, rows: np.ndarray) -> Rigid2 | Rigid3 | Similarity3:
    if kind == "SE2":
        return Rigid2(rows[:, 2].copy(), rows[:, :2].copy())
    rigid = Rigid3.from_quat_wxyz(rows[:, [6, 3, 4, 5]], rows[:, :3])
    if kind == "SE3:QUAT":
        return rigid
    return Similarity3(rows[:, 7].copy(), rigid.rotation, rigid.translation)


def _numbers(motions: Rigid2 | Rigid3 | Similarity3) -> np.ndarray:
    if isinstance(motions, Rigid2):
        return np.concatenate([motions.translation, motions.angle_rad[:, None]], axis=1)
    quat_wxyz = Rotation3(motions.rotation).as_quat_wxyz()
    columns = [motions.translation, quat_wxyz[:, [1, 2, 3, 0]]]
    if isinstance(motions, Similarity3):
        columns.append(motions.scale[:, None])
    return np.concatenate(columns, axis=1)


def _text(row: np.ndarray) -> str:
    return " ".join(f"{value:.17g}" for value in row)
