"""Choice of a view for each face by belief propagation."""

from epipole._jit import kernel


@kernel
def send_messages(label, cost, neighbors, jump, before, start, stop, after):
    """Min-sum messages of faces start..stop to their neighbors (Felzenszwalb and Huttenlocher, IJCV 2006; Potts model).

    label, cost (m, k): candidate views of each face, -1 for none, and their costs. neighbors (m, 3): faces across the edges, -1 for none.
    before, after (m, 3, k): the messages that each face receives across its edges, by its own candidates. A different view across an edge costs
    `jump`. after[i, e] is computed from neighbor n = neighbors[i, e]: min(h(l), min h + jump) minus the minimum, with
    h(l) = cost(n, l) + the messages that n received from others than i.
    """
    count = label.shape[1]
    for i in range(start, stop):
        for e in range(3):
            n = neighbors[i, e]
            if n < 0:
                continue
            lowest = 1e30
            for k in range(count):
                if label[n, k] >= 0:
                    lowest = min(lowest, _belief(label, cost, neighbors, before, n, k, i))
            for k in range(count):
                found = lowest + jump
                if label[i, k] >= 0:
                    for j in range(count):
                        if label[n, j] == label[i, k]:
                            found = min(found, _belief(label, cost, neighbors, before, n, j, i))
                after[i, e, k] = found - lowest if lowest < 1e30 else 0.0


@kernel
def _belief(label, cost, neighbors, messages, face, k, without):
    """Cost of a candidate of a face plus the messages from all neighbors but one (-1: all)."""
    total = cost[face, k]
    for e in range(3):
        if neighbors[face, e] >= 0 and neighbors[face, e] != without:
            total += messages[face, e, k]
    return total


@kernel
def choose_labels(label, cost, neighbors, messages, start, stop, out):
    """The candidate with the lowest belief of faces start..stop; -1 for a face without any."""
    for i in range(start, stop):
        best, lowest = -1, 1e30
        for k in range(label.shape[1]):
            if label[i, k] >= 0:
                belief = _belief(label, cost, neighbors, messages, i, k, -1)
                if belief < lowest:
                    best, lowest = label[i, k], belief
        out[i] = best
