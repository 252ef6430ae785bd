"""Sparsity of a bundle problem: nodes that observe each point, and pairs of nodes with a common point."""

import numpy as np

from epipole._jit import kernel


@kernel
def find_entries(offsets, image, nodes, role, start, stop, entry_start, node, slot):
    """The distinct nodes that observe each of points start..stop.

    With an empty `node`, entry_start[j + 1] receives their number; otherwise they go to node[entry_start[j] :], and `slot`
    (observations, 3) receives those of the frame, the camera and the sensor of each observation. Fixed points (role 0) have
    none.
    """
    counting = len(node) == 0
    for j in range(start, stop):
        count = 0
        for k in range(offsets[j], offsets[j + 1]):
            for part in range(3):
                wanted = nodes[image[k], part]
                if role[j] == 0 or wanted < 0:
                    if not counting:
                        slot[k, part] = -1
                    continue
                if counting:
                    # Is it new among the nodes of earlier observations?
                    known = False
                    for other in range(offsets[j], k):
                        if nodes[image[other], part] == wanted:
                            known = True
                            break
                    if not known:
                        count += 1
                    continue
                first = entry_start[j]
                at = 0
                while at < count and node[first + at] != wanted:
                    at += 1
                if at == count:
                    node[first + at] = wanted
                    count += 1
                slot[k, part] = at
        if counting:
            entry_start[j + 1] = count


@kernel
def sort_by_node(start, node, point, by_node, node_start, fill):
    """Sort entries by node (counting sort) and set the point of each entry; node_start holds cumulative counts."""
    for n in range(len(fill)):
        fill[n] = node_start[n]
    for j in range(len(start) - 1):
        for e in range(start[j], start[j + 1]):
            point[e] = j
            by_node[fill[node[e]]] = e
            fill[node[e]] += 1


@kernel
def find_pattern(start, node, point, by_node, node_start, mark, row_count, column):
    """For each node, the nodes b <= a with a common point; only their number if `column` is empty."""
    counting = len(column) == 0
    found = 0
    for a in range(len(row_count)):
        mark[a] = -1
    for a in range(len(row_count)):
        before = found
        for at in range(node_start[a], node_start[a + 1]):
            j = point[by_node[at]]
            for e in range(start[j], start[j + 1]):
                b = node[e]
                if b <= a and mark[b] != a:
                    mark[b] = a
                    if not counting:
                        column[found] = b
                    found += 1
        row_count[a] = found - before
    return found


@kernel
def count_pairs(start, node, row_work):
    """Add to row_work[a] the number of entry pairs in row a of the reduced system; returns the total."""
    total = np.int64(0)
    for j in range(len(start) - 1):
        many = start[j + 1] - start[j]
        total += many * many
        for e in range(start[j], start[j + 1]):
            row_work[node[e]] += many
    return total
