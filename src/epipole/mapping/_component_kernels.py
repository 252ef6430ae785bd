"""Components of keypoints that matches join, with at most one keypoint of each image: union-find (Tarjan 1975) with the images of each set.

The images of a component are consecutive in memory, because a match between two components compares all of them. They are in a block whose
length is the power of two that fits them; the smaller component is added to the block of the larger one, or both move to a new block.
"""

from typing import NamedTuple

import numpy as np

from epipole._jit import kernel


class Components(NamedTuple):
    """Disjoint sets of keypoint rows; `first` and `size` hold for their smallest rows."""

    parent: np.ndarray  # (r,) int64, toward the smallest row of each component
    first: np.ndarray  # (r,) int64, of its images in the array of all members
    size: np.ndarray  # (r,) int64, number of its images
    stamp: np.ndarray  # (n,) int64, the last match that has marked each image


@kernel
def _root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel(allocates=True)
def connect_without_conflict(
    order, match_offsets, image1, image2, keypoint1, keypoint2, starts, num_before, found, members, used
):
    """Union-find over the matches of pairs of images, in the given order of the pairs.

    A match that would put two keypoints of one image into a component is rejected: one of the matches in it is wrong,
    and the earlier ones are stronger. `starts` is the first keypoint row of each image; `num_before` counts the matches of earlier
    calls. Returns the number of matches including these, the images of all components, and how much of that array is used.
    """
    number = num_before
    for pair in order:
        first, second = starts[image1[pair]], starts[image2[pair]]
        for m in range(match_offsets[pair], match_offsets[pair + 1]):
            number += 1
            a, b = _root(found.parent, first + keypoint1[m]), _root(found.parent, second + keypoint2[m])
            if a == b:
                continue
            if used + _block(found.size[a] + found.size[b]) > len(members):
                longer = np.zeros(2 * len(members) + _block(found.size[a] + found.size[b]), members.dtype)
                longer[:used] = members[:used]
                members = longer
            used = _join(a, b, number, found, members, used)
    return number, members, used


@kernel
def find_roots(parent):
    """parent[i] becomes the smallest keypoint row of i's component."""
    for i in range(len(parent)):
        parent[i] = _root(parent, i)


@kernel
def _block(size):
    """The smallest power of two that is at least `size`."""
    length = 1
    while length < size:
        length *= 2
    return length


@kernel
def _copy(members, source, target, count):
    for k in range(count):
        members[target + k] = members[source + k]


@kernel
def _join(a, b, number, found, members, used):
    """Join the components of two roots, unless both have a keypoint of the same image; returns how much of `members` is used."""
    if found.size[a] < found.size[b]:
        a, b = b, a
    first, size, other, extra = found.first[a], found.size[a], found.first[b], found.size[b]
    for k in range(other, other + extra):
        found.stamp[members[k]] = number
    for k in range(first, first + size):
        if found.stamp[members[k]] == number:
            return used
    if size + extra > _block(size):
        _copy(members, first, used, size)
        first = used
        used += _block(size + extra)
    _copy(members, other, first + size, extra)
    root = min(a, b)
    found.parent[max(a, b)] = root
    found.first[root], found.size[root] = first, size + extra
    return used
