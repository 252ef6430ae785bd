"""A pose graph with a loop

A robot that adds up its own motions drifts. When it recognises a place, one more measured motion ties the end
of the way to its beginning, and the poses that agree best with all motions spread the error over the way. One
false recognition, in turn, bends everything.
"""

from dataclasses import replace

import numpy as np

from epipole.geometry import Rigid3, Rotation3
from epipole.metrics import absolute_error
from epipole.optim import PoseGraph, optimize_pose_graph, optimize_pose_graph_robustly

# Sixty poses around a circle of three metres, always looking ahead, a little up and down: the truth.

n = 60
angle = 2 * np.pi * np.arange(n) / n
center = np.stack([3 * np.cos(angle), 3 * np.sin(angle), 0.3 * np.sin(3 * angle)], axis=1)
true = Rigid3(Rotation3.exp(np.stack([0 * angle, 0 * angle, angle], axis=1)).matrix, center)

# Odometry is the motion from each pose to the next, wrong by a centimetre and half a degree. Motions are
# `first_from_second`, their errors are twists (translation, rotation).

rng = np.random.default_rng(2)
sigma = np.array([0.01, 0.01, 0.01, *np.deg2rad([0.5, 0.5, 0.5])])


def measured(first, second):
    """The true motions between poses, each with an error of its own."""
    error = Rigid3.exp(sigma * rng.standard_normal((len(first), 6)))
    return true[first].inverse() @ true[second] @ error


first, second = np.arange(n - 1), np.arange(1, n)
steps = measured(first, second)

# Adding them up: world_from_next = world_from_here @ here_from_next. The way does not close.

positions = [true[0]]
for step in range(n - 1):
    positions.append(positions[-1] @ steps[step])
drifted = Rigid3(np.stack([p.rotation for p in positions]), np.stack([p.translation for p in positions]))
off_m = np.linalg.norm(drifted.translation - true.translation, axis=1)
print(f"drift: {off_m[-1]:.2f} m after a way of {2 * np.pi * 3:.0f} m")
assert off_m[-1] > 0.1 and off_m[1] < 0.05

# The graph holds places (a first guess), edges, and the inverse covariance of each edge. Three edges tie the
# end to the beginning. With a file of others: `epipole.io.read_g2o("sphere2500.g2o").graph`.

loop_first, loop_second = np.array([n - 1, n - 2, n - 3]), np.array([0, 0, 1])
loops = measured(loop_first, loop_second)


def joined(a, b):
    """Two batches of motions as one."""
    return Rigid3(np.concatenate([a.rotation, b.rotation]), np.concatenate([a.translation, b.translation]))


graph = PoseGraph(
    world_from_body=drifted,
    first=np.concatenate([first, loop_first]),
    second=np.concatenate([second, loop_second]),
    first_from_second=joined(steps, loops),
    information=np.tile(np.diag(1 / sigma**2), (n - 1 + 3, 1, 1)),
)
found = optimize_pose_graph(graph)
print(found)
assert found.converged and found.final_cost < 0.05 * found.initial_cost

# The first pose is held; the others moved. The error of the places is a fraction of the drift.

before = absolute_error(drifted, true, "none").position.rmse
after = absolute_error(found.world_from_body, true, "none").position.rmse
print(f"places off by {before:.3f} m before, {after:.3f} m after")
assert after < 0.5 * before

# Squared residuals, weighed by the information, are a chi-square: their sum is near the edges' six numbers
# each less the poses' six numbers each, if the stated errors are right.

freedom = 6 * len(graph.first) - 6 * (n - 1)
total = found.squared_residuals.sum()
print(f"sum of squared residuals {total:.1f}, {freedom} degrees of freedom")
assert 4.0 < total < 40.0

# A false loop says that pose 45 is pose 15, on the other side of the circle. Plain least squares believes it.

wrong = joined(graph.first_from_second, Rigid3.identity(1))
fooled = replace(
    graph,
    first=np.append(graph.first, 45),
    second=np.append(graph.second, 15),
    first_from_second=wrong,
    information=np.concatenate([graph.information, graph.information[:1]]),
)
bent = absolute_error(optimize_pose_graph(fooled).world_from_body, true, "none").position.rmse
robust = optimize_pose_graph_robustly(fooled)
kept = absolute_error(robust.world_from_body, true, "none").position.rmse
print(
    f"with a false loop: {bent:.2f} m by least squares, {kept:.3f} m robustly; kept {robust.kept_mask[-4:]}"
)
assert bent > 5 * after and kept < 1.5 * after
assert robust.kept_mask[:-1].all() and not robust.kept_mask[-1]
