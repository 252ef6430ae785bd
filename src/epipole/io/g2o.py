"""Pose graphs in g2o's text format: the plane, space, and space with scale.

Information matrices of edges in space are read as those of (translation, rotation vector), as GTSAM does; g2o itself means
the imaginary part of a quaternion, half a rotation vector.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Int64

from epipole._checks import as_path
from epipole._declared import checked
from epipole._declared.arrays import as_array
from epipole.errors import FileFormatError, ShapeError
from epipole.geometry import Rigid2, Rigid3, Rotation3, Similarity3
from epipole.io.atomic import atomic_write
from epipole.io.files import file_bytes
from epipole.optim import PoseGraph
from epipole.optim.pose_graph import not_definite

_KINDS = {"SE2": (3, 3), "SE3:QUAT": (7, 6), "SIM3:QUAT": (8, 7)}
"""Numbers of a motion, and size of its tangent."""
_IGNORED = ("PARAMS_", "#")
"""Parameters are used by edges of other kinds, which are refused."""
_FEW = 5
_LEAST_FRACTION = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class G2oFile:
    """A pose graph and the names of its places in the file."""

    graph: PoseGraph
    ids: Int64[np.ndarray, " n"]
    """Ascending."""
    mended_edges: Int64[np.ndarray, " e"]
    """Edges of the graph whose information matrices were not positive definite, and were replaced."""

    def __repr__(self) -> str:
        return f"G2oFile({self.graph!r})"


@checked
def read_g2o(path: str | Path, *, indefinite: Literal["refuse", "nearest"] = "refuse") -> G2oFile:
    """Read vertices and edges of one kind, and which vertices are fixed; parameters and comments are passed over.

    Args:
        path: the file.
        indefinite: what becomes of edges whose information matrices are not positive definite. "refuse": the message
            names them. "nearest": the nearest matrix takes the place, with the eigenvalues below a billionth of the
            largest raised to that (Higham, Linear Algebra Appl. 1988); `mended_edges` names them.

    Raises:
        FileFormatError: the file cannot be read, mixes kinds, names a vertex that is not there, has a broken line, or an
            information matrix that no measurement has; the message names the line, or the edges.
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
            raise FileFormatError(path, f"line {number}: {words[0]} is none of the known kinds")
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
            raise FileFormatError(path, f"line {number}: {wanted} finite numbers are needed after the names")
        _require_names(path, number, index)
        if not _is_motion(numbers[:size]):
            raise FileFormatError(
                path, f"line {number}: {words[0]} holds no unit quaternion or no positive scale"
            )
        if what == "VERTEX":
            if index[0] in vertices:
                raise FileFormatError(path, f"line {number}: vertex {index[0]} stands there twice")
            vertices[index[0]] = numbers
        else:
            edges.append((index[0], index[1]))
            values.append(numbers)
    if kind is None or not vertices:
        raise FileFormatError(path, "no vertices: this is no pose graph")
    return _with_fixed(path, _assemble(path, kind, vertices, edges, values, indefinite), fixed)


def _with_fixed(path: Path, found: G2oFile, fixed: dict[int, int]) -> G2oFile:
    """The graph with the vertices that are fixed, by the lines that name them."""
    known = set(found.ids.tolist())
    for name, number in fixed.items():
        if name not in known:
            raise FileFormatError(path, f"line {number}: FIX names vertex {name}, which is not there")
    rows = np.searchsorted(found.ids, np.array(sorted(fixed), np.int64)).astype(np.int64)
    return replace(found, graph=replace(found.graph, fixed=rows))


def _fixed_names(path: Path, number: int, words: list[str]) -> list[int]:
    """Of a line FIX, which holds one vertex or more."""
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
        raise FileFormatError(path, f"line {number}: a name must be a number of 64 bits")


@checked
def write_g2o(path: str | Path, graph: PoseGraph, ids: Any = None) -> None:
    """Write a pose graph; places are numbered from zero unless `ids` names them.

    Raises:
        ShapeError: the names are not one whole number per place.
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
        raise FileFormatError(path, f"an edge names vertex {missing[0]}, which is not there")
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
        'read_g2o(..., indefinite="nearest") takes the nearest that are'
    )


def _nearest_definite(path: Path, information: np.ndarray) -> np.ndarray:
    """The symmetric matrices (n, d, d) with eigenvalues of at least a billionth of the largest."""
    values, vectors = np.linalg.eigh(information)
    if not (values[:, -1:] > 0).all():
        raise FileFormatError(
            path, "an edge's information matrix has no positive eigenvalue: it measures nothing"
        )
    raised = np.maximum(values, _LEAST_FRACTION * values[:, -1:])
    out = (vectors * raised[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return 0.5 * (out + np.swapaxes(out, 1, 2))


def _is_motion(numbers: list[float]) -> bool:
    """Whether a row can be a motion: a quaternion near unit length, a scale above zero."""
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
