"""Triangle meshes with a color at each vertex."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from epipole._checks import Declared, check_fields, check_indices


@dataclass(frozen=True, slots=True, eq=False)
class Mesh(Declared):
    """Triangles with corners in counterclockwise order, seen from outside."""

    vertices_in_world: Float64[np.ndarray, "n 3"]
    faces: Int64[np.ndarray, "m 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    num_components: int = 0
    """Number of connected components found; 0 if not counted."""
    num_removed: int = 0
    """Number of small components that were removed."""

    def __post_init__(self) -> None:
        """Check the corners.

        Raises:
            ShapeError: a column has the wrong type or shape, or a corner refers to a missing vertex.
        """
        check_fields(self)
        check_indices(self.faces, "faces", len(self.vertices_in_world))

    def __len__(self) -> int:
        return len(self.faces)

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices_in_world):,} vertices, {len(self.faces):,} triangles)"

    def without_small_components(self, least: float) -> Mesh:
        """Remove connected components with fewer triangles than a fraction of the largest one.

        Args:
            least: the fraction; 0 keeps all components.
        """
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        n = len(self.vertices_in_world)
        ends = self.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
        graph = coo_matrix((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(n, n))
        component = connected_components(graph, directed=False)[1][self.faces[:, 0]]
        sizes = np.bincount(component)
        is_kept = sizes >= max(least * sizes.max(initial=0), 1)
        num_components = int((sizes > 0).sum())
        used, corners = np.unique(self.faces[is_kept[component]], return_inverse=True)
        return Mesh(
            self.vertices_in_world[used],
            corners.reshape(-1, 3),
            self.rgb[used],
            num_components,
            num_components - int(is_kept.sum()),
        )
