"""SLAM, frame by frame

A robot cannot wait for all images: it asks after every frame where it is. `Slam.track` takes one frame and
answers with a pose, or with the reason why there is none; the map grows behind it.
"""

import numpy as np

import epipole
from epipole.metrics import absolute_error
from epipole.synthetic.rides import loop_room

# A camera with a depth sensor is carried through a furnished room: rendered frames, with the true path. A
# robot's own loop takes grey images of 8 bits and depth in metres as float32 (0 for unknown) from its
# driver.

ride = loop_room(46, size=(320, 240))
sensor = epipole.DepthCamera(ride.camera, epipole.Rigid3.identity())
slam = epipole.Slam(epipole.SlamCamera(ride.camera, depth=sensor))

# The loop. One camera alone (no depth) works the same, waits until it has moved sideways, and has no metres;
# a second camera is given by `epipole.SlamCamera(lens, baseline=0.12)` and `epipole.Frame(seconds, left,
# right)`. From frame 24 to 29 somebody holds a hand before the lens.

covered = range(24, 30)
answers = []
for n in range(0, len(ride), 2):
    image = ride.left(n)
    hidden = n in covered
    grey = np.full_like(image.grey, 90) if hidden else image.grey
    depth = np.zeros_like(image.depth) if hidden else image.depth
    found = slam.track(epipole.Frame(float(ride.timestamp_s[n]), grey, depth=depth))
    answers.append((n, found))
    if found.world_from_body is None:
        print(f"frame {n}: {found.state.value} ({found.reason})")

# The world is the first frame's camera, so the first pose is the identity.

first = answers[0][1]
assert np.allclose(first.world_from_body.as_matrix(), np.eye(4))

# A place that is not known is None, never a guess. Once the lens is free again, the camera is recognised in
# the map.

registered = {n: found for n, found in answers if found.world_from_body is not None}
assert not any(n in registered for n in covered)
assert all(n in registered for n in range(0, len(ride), 2) if n not in covered)
print(f"{len(registered)} of {len(answers)} frames have a place")

# Each answer says how sure it is: the covariance of (translation, rotation) in the camera's axes, in metres
# and radians.

last = answers[-1][1]
sigma = np.sqrt(np.diag(last.covariance))
place_mm, rotation_deg = 1000 * np.linalg.norm(sigma[:3]), np.degrees(np.linalg.norm(sigma[3:]))
print(f"last pose known to {place_mm:.1f} mm and {rotation_deg:.3f} degrees")
assert 0 < np.linalg.norm(sigma[:3]) < 0.05

# After the last frame the whole map is adjusted. `trajectory` then tells the path as it is known now; the
# answers above are what was known at the time.

slam.finish()
path = slam.trajectory()
rows = np.searchsorted(ride.timestamp_s, path.timestamp_s - 1e-6)
truth = ride.world_from_camera[rows]
final = absolute_error(path.world_from_body, truth, "rigid").position
print(path)
print(f"path off by {1000 * final.rmse:.1f} mm (root mean square), {1000 * final.max:.1f} mm at most")
assert len(path) == len(registered) and final.rmse < 0.01
from_first = ride.world_from_camera[0].inverse() @ ride.world_from_camera
at_once_m = [
    np.linalg.norm(found.world_from_body.translation - from_first[n].translation)
    for n, found in registered.items()
]
print(f"known at the time: off by {1000 * np.sqrt(np.mean(np.square(at_once_m))):.1f} mm")
assert max(at_once_m) < 0.05 and at_once_m[-1] < 5 * np.linalg.norm(sigma[:3])

# Metres need no fitting here, for the depth sensor tells them: the similarity onto the true path has a scale
# of nearly one.

scale = float(absolute_error(path.world_from_body, truth, "similarity").truth_from_estimate.scale)
print(f"scale against the truth: {scale:.4f}")
assert abs(scale - 1.0) < 0.02

# `epipole.slam("FOLDER", "OUT")` runs the same over a recording (TUM, EuRoC, KITTI, 7-Scenes, a video) and
# writes trajectory, map, covariances and a page; a later run continues in the map with `--map OUT`.
