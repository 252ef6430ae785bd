"""Pose graph with a loop closure

Odometry drifts, because the errors of all motions accumulate. When a robot revisits a position, a loop
closure measures the motion between two distant poses of the trajectory. Pose graph optimization then
distributes the error over all poses. A false loop closure distorts the graph, unless the optimization is
robust.
"""

from dataclasses import replace

import numpy as np

from epipole.geometry import Rigid3, Rotation3
from epipole.metrics import absolute_error
from epipole.optim import PoseGraph, optimize_pose_graph, optimize_pose_graph_robustly

# Generate 60 poses on a circle with a radius of three meters. The camera looks ahead, and its height varies
# slightly.

n = 60
angle = 2 * np.pi * np.arange(n) / n
center = np.stack([3 * np.cos(angle), 3 * np.sin(angle), 0.3 * np.sin(3 * angle)], axis=1)
truth = Rigid3(Rotation3.exp(np.stack([0 * angle, 0 * angle, angle], axis=1)).matrix, center)

# Odometry measures the motion from each pose to the next, with errors of 1 cm and 0.5 degrees per axis.
# Motions are named `first_from_second`, and their errors are twists (translation, rotation).

rng = np.random.default_rng(2)
sigma = np.array([0.01, 0.01, 0.01, *np.deg2rad([0.5, 0.5, 0.5])])


def measured(first, second):
    """Return the true motions between poses with random errors."""
    error = Rigid3.exp(sigma * rng.standard_normal((len(first), 6)))
    return truth[first].inverse() @ truth[second] @ error


first, second = np.arange(n - 1), np.arange(1, n)
steps = measured(first, second)

# Chain the motions: world_from_next = world_from_current @ current_from_next. The trajectory does not close.

poses = [truth[0]]
for step in range(n - 1):
    poses.append(poses[-1] @ steps[step])
drifted = Rigid3(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses]))
drift_m = np.linalg.norm(drifted.translation - truth.translation, axis=1)
print(f"drift: {drift_m[-1]:.2f} m after a distance of {2 * np.pi * 3:.0f} m")
assert drift_m[-1] > 0.1 and drift_m[1] < 0.05

# A `PoseGraph` has initial poses, edges, and the information matrix (inverse covariance) of each edge. Three
# edges connect the end of the trajectory to its start. `epipole.io.read_g2o("sphere2500.g2o").graph` reads a
# graph from a file.

loop_first, loop_second = np.array([n - 1, n - 2, n - 3]), np.array([0, 0, 1])
loops = measured(loop_first, loop_second)


def concatenate(a, b):
    """Concatenate two batches of motions."""
    return Rigid3(np.concatenate([a.rotation, b.rotation]), np.concatenate([a.translation, b.translation]))


graph = PoseGraph(
    world_from_body=drifted,
    first=np.concatenate([first, loop_first]),
    second=np.concatenate([second, loop_second]),
    first_from_second=concatenate(steps, loops),
    information=np.tile(np.diag(1 / sigma**2), (n - 1 + 3, 1, 1)),
)
found = optimize_pose_graph(graph)
print(found)
assert found.converged and found.final_cost < 0.05 * found.initial_cost

# The optimization keeps the first pose fixed. The error of the other poses is now a fraction of the drift.

before = absolute_error(drifted, truth, "none").position.rmse
after = absolute_error(found.world_from_body, truth, "none").position.rmse
print(f"RMS position error {before:.3f} m before, {after:.3f} m after")
assert after < 0.5 * before

# If the covariances are correct, the sum of the squared weighted residuals follows a chi-square distribution.
# Its mean is the number of degrees of freedom: six per edge, minus six per free pose.

dof = 6 * len(graph.first) - 6 * (n - 1)
total = found.squared_residuals.sum()
print(f"sum of squared residuals {total:.1f}, {dof} degrees of freedom")
assert 4.0 < total < 40.0

# A false loop closure claims that pose 45 equals pose 15, on the opposite side of the circle. It distorts the
# least-squares result, but `optimize_pose_graph_robustly` rejects it.

motions = concatenate(graph.first_from_second, Rigid3.identity(1))
corrupted = replace(
    graph,
    first=np.append(graph.first, 45),
    second=np.append(graph.second, 15),
    first_from_second=motions,
    information=np.concatenate([graph.information, graph.information[:1]]),
)
least_squares_m = absolute_error(optimize_pose_graph(corrupted).world_from_body, truth, "none").position.rmse
robust = optimize_pose_graph_robustly(corrupted)
robust_m = absolute_error(robust.world_from_body, truth, "none").position.rmse
print(f"least squares {least_squares_m:.2f} m, robust {robust_m:.3f} m; kept {robust.kept_mask[-4:]}")
assert least_squares_m > 5 * after and robust_m < 1.5 * after
assert robust.kept_mask[:-1].all() and not robust.kept_mask[-1]
