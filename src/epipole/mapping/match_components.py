"""Components of keypoints joined by verified matches: tracks without points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int32, Int64

from epipole._checks import Declared, check_indices, check_offsets, checked
from epipole.errors import ShapeError
from epipole.mapping import _component_kernels as component_kernels
from epipole.mapping import _track_kernels as kernels
from epipole.scene import ViewGraph

LEAST_TRACK = 3
"""Images in which a chosen track must be: a track in two does not relate their distance to any other."""


@dataclass(frozen=True, slots=True, eq=False)
class MatchComponents(Declared):
    """Keypoints connected by verified matches: rows offsets[t] to offsets[t + 1] are component t."""

    offsets: Int64[np.ndarray, " t1"]
    image: Int32[np.ndarray, " r"]
    keypoint: Int32[np.ndarray, " r"]

    def __len__(self) -> int:
        return len(self.offsets) - 1


@dataclass(frozen=True, slots=True, eq=False)
class FurtherMatches(Declared):
    """Matches that a model predicted: they extend tracks, and are no evidence for any geometry. Best first."""

    image1: Int32[np.ndarray, " m"]
    keypoint1: Int32[np.ndarray, " m"]
    image2: Int32[np.ndarray, " m"]
    keypoint2: Int32[np.ndarray, " m"]

    def __len__(self) -> int:
        return len(self.image1)

    @checked
    def joined(self, later: FurtherMatches) -> FurtherMatches:
        """These, and then those of a later search."""
        return FurtherMatches(
            np.concatenate([self.image1, later.image1]),
            np.concatenate([self.keypoint1, later.keypoint1]),
            np.concatenate([self.image2, later.image2]),
            np.concatenate([self.keypoint2, later.keypoint2]),
        )

    def __repr__(self) -> str:
        return f"FurtherMatches({len(self)})"


@checked
def connect_matches(
    view_graph: ViewGraph, keypoint_offsets: Int64[np.ndarray, " n1"], further: FurtherMatches | None = None
) -> MatchComponents:
    """Merge matches into components with at most one keypoint per image: those of the strongest pair first, further ones last."""
    check_offsets(keypoint_offsets, "keypoint_offsets")
    check_matches(view_graph, np.diff(keypoint_offsets))
    parent = np.arange(keypoint_offsets[-1], dtype=np.int64)
    image = np.repeat(np.arange(len(keypoint_offsets) - 1, dtype=np.int32), np.diff(keypoint_offsets))
    found = component_kernels.Components(
        parent, parent.copy(), np.ones(len(parent), np.int64), np.zeros(len(keypoint_offsets), np.int64)
    )
    strongest_first = np.argsort(-view_graph.num_inliers().astype(np.int64), kind="stable")
    graph = view_graph.image1, view_graph.image2, view_graph.keypoint1, view_graph.keypoint2
    number, members, used = component_kernels.connect_without_conflict(
        strongest_first, view_graph.match_offsets, *graph, keypoint_offsets, 0, found, image, len(image)
    )
    if further is not None:
        each = np.arange(len(further) + 1)
        matches = further.image1, further.image2, further.keypoint1, further.keypoint2
        component_kernels.connect_without_conflict(
            each[:-1], each, *matches, keypoint_offsets, number, found, members, used
        )
    component_kernels.find_roots(parent)
    sizes = np.bincount(parent, minlength=len(parent))
    rows = np.flatnonzero(sizes[parent] >= 2)
    rows = rows[np.argsort(parent[rows], kind="stable")]
    image = image[rows]
    return MatchComponents(
        np.concatenate([[0], np.cumsum(sizes[sizes >= 2])]).astype(np.int64),
        image,
        (rows - keypoint_offsets[image]).astype(np.int32),
    )


def num_keypoints_in(view_graph: ViewGraph, num_images: int) -> Int64[np.ndarray, " n"]:
    """For each image, the largest keypoint of its matches plus one."""
    out = np.zeros(num_images, np.int64)
    pairs = np.flatnonzero(view_graph.num_inliers())
    if len(pairs):
        for image, keypoint in (
            (view_graph.image1, view_graph.keypoint1),
            (view_graph.image2, view_graph.keypoint2),
        ):
            largest = np.maximum.reduceat(keypoint, view_graph.match_offsets[pairs])
            np.maximum.at(out, image[pairs], largest + 1)
    return out


@checked
def choose_tracks(
    components: MatchComponents,
    is_member: Bool[np.ndarray, " n"],
    per_image: int,
    view_graph: ViewGraph | None = None,
    per_pair: int = 0,
) -> Int64[np.ndarray, " k"]:
    """Rows of the longest components that give each image about `per_image` observations, and each pair `per_pair`.

    The longest components of an image may all lie on one side of it, and not connect it with the images on the other.

    Args:
        components: keypoints connected by matches.
        is_member: mask of images; others do not count.
        per_image: a component is chosen if one of its images has fewer observations so far.
        view_graph: pairs of images whose matches should be among the chosen components.
        per_pair: number of such matches of each pair.

    Returns:
        Rows of the chosen components in member images, grouped by component; each component has three or more.
    """
    check_offsets(components.offsets, "components.offsets", len(components.image))
    check_indices(components.image, "components.image", len(is_member))
    component = np.repeat(np.arange(len(components)), np.diff(components.offsets))
    inside = is_member[components.image]
    lengths = np.bincount(component[inside], minlength=len(components))
    order = np.argsort(-lengths, kind="stable")
    chosen = np.zeros(len(components), bool)
    kernels.cover_images(
        components.offsets,
        components.image,
        is_member,
        order[lengths[order] >= LEAST_TRACK],
        per_image,
        np.zeros(len(is_member), np.int64),
        chosen,
    )
    if view_graph is not None:
        check_indices(view_graph.image1, "view_graph.image1", len(is_member))
        check_indices(view_graph.image2, "view_graph.image2", len(is_member))
        inner = view_graph.select(is_member[view_graph.image1] & is_member[view_graph.image2])
        if len(components):
            chosen |= _missing_in_pairs(components, inner, per_pair, lengths, chosen)
    return np.flatnonzero(inside & chosen[component])


def _missing_in_pairs(
    components: MatchComponents, view_graph: ViewGraph, per_pair: int, lengths: np.ndarray, chosen: np.ndarray
) -> np.ndarray:
    """(t,) the longest components that pairs of images with fewer than `per_pair` chosen matches need."""
    num_images = 1 + max(
        int(a.max(initial=0)) for a in (components.image, view_graph.image1, view_graph.image2)
    )
    counts = num_keypoints_in(view_graph, num_images)
    np.maximum.at(counts, components.image, components.keypoint + 1)
    pair = np.repeat(np.arange(len(view_graph)), view_graph.num_inliers())
    starts = np.concatenate([[0], np.cumsum(counts)])
    component_of = np.full(starts[-1], -1)
    component_of[starts[components.image] + components.keypoint] = np.repeat(
        np.arange(len(components)), np.diff(components.offsets)
    )
    component = component_of[starts[view_graph.image1[pair]] + view_graph.keypoint1]
    is_used = component == component_of[starts[view_graph.image2[pair]] + view_graph.keypoint2]
    is_used &= (component >= 0) & (lengths[component] >= LEAST_TRACK)
    num_missing = per_pair - np.bincount(pair[is_used & chosen[component]], minlength=len(view_graph))
    is_wanted = is_used & ~chosen[component] & (num_missing > 0)[pair]
    pair, component = pair[is_wanted], component[is_wanted]
    ranked = np.lexsort((-lengths[component], pair))
    pair, component = pair[ranked], component[ranked]
    rank = np.arange(len(pair)) - np.searchsorted(pair, pair)
    needed = np.zeros(len(chosen), bool)
    needed[component[rank < num_missing[pair]]] = True
    return needed


def check_matches(view_graph: ViewGraph, num_keypoints: Int64[np.ndarray, " n"]) -> None:
    """Check that matches refer to existing keypoints.

    Args:
        view_graph: pairs of images and their matches.
        num_keypoints: one per image.

    Raises:
        ShapeError: a match refers to a missing keypoint.
    """
    check_offsets(view_graph.match_offsets, "match_offsets", len(view_graph.keypoint1))
    if len(view_graph.match_offsets) != len(view_graph) + 1:
        raise ShapeError(f"match_offsets must have {len(view_graph) + 1} rows")
    for side in ("1", "2"):
        image, keypoint = getattr(view_graph, f"image{side}"), getattr(view_graph, f"keypoint{side}")
        check_indices(image, f"image{side}", len(num_keypoints))
        most = np.repeat(num_keypoints[image], view_graph.num_inliers())
        if not ((keypoint >= 0) & (keypoint < most)).all():
            raise ShapeError(f"keypoint{side} refers to a keypoint that does not exist")


def check_components(components: MatchComponents, num_keypoints: Sequence[int]) -> None:
    """Check that components refer to existing keypoints.

    Raises:
        ShapeError: a component refers to a missing keypoint.
    """
    check_offsets(components.offsets, "components.offsets", len(components.image))
    check_indices(components.image, "components.image", len(num_keypoints))
    most = np.array(num_keypoints, np.int64)[components.image]
    if not ((components.keypoint >= 0) & (components.keypoint < most)).all():
        raise ShapeError("components.keypoint refers to a keypoint that does not exist")


def rows_of_groups(offsets: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """All rows of the given groups, such as components or pairs, in order; group k has the rows from offsets[k] to offsets[k + 1]."""
    counts = offsets[groups + 1] - offsets[groups]
    starts = np.repeat(offsets[groups] - np.concatenate([[0], np.cumsum(counts)[:-1]]), counts)
    return starts + np.arange(counts.sum())


class ComponentChanges:
    """The time of the last change of each component, so that a growing model looks only at what has changed; times are numbers of changes.

    Args:
        row_component: (r,) the component of each row.
        num_components: number of components, all of which have changed.
    """

    def __init__(self, row_component: Int64[np.ndarray, " r"], num_components: int) -> None:
        self._component_of_row = row_component
        self._time = np.ones(num_components, np.int64)
        self.now = 1

    def note(self, rows: np.ndarray) -> None:
        """The components of these rows change now."""
        self.now += 1
        self._time[self._component_of_row[rows]] = self.now

    def note_all(self) -> None:
        """All components change now."""
        self.now += 1
        self._time[:] = self.now

    def since(self, time: int) -> Int64[np.ndarray, " k"]:
        """The components that have changed after a time, in order; after 0: all."""
        return np.flatnonzero(self._time > time).astype(np.int64)
