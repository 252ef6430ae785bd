"""SLAM, frame by frame

A robot needs its pose after every frame. `Slam.track` takes one frame and returns a pose, or the reason why
the pose is unknown. It also extends the map.
"""

import numpy as np

import epipole
from epipole.metrics import absolute_error
from epipole.synthetic.rides import loop_room

# Render the frames of a depth camera that moves through a furnished room. On a robot, the driver delivers
# 8-bit gray images and depth in meters as float32, with 0 for unknown depth.

ride = loop_room(46, size=(320, 240))
sensor = epipole.DepthCamera(ride.camera, epipole.Rigid3.identity())
slam = epipole.Slam(epipole.SlamCamera(ride.camera, depth=sensor))

# Track every second frame. From frame 24 to 29, a hand covers the camera. A single camera without depth works
# the same way, but it must move sideways first, and its scale is unknown. For a stereo camera, pass
# `epipole.SlamCamera(camera, baseline=0.12)` and `epipole.Frame(seconds, left, right)`.

covered = range(24, 30)
results = []
for n in range(0, len(ride), 2):
    image = ride.left(n)
    is_covered = n in covered
    gray = np.full_like(image.gray, 90) if is_covered else image.gray
    depth = np.zeros_like(image.depth) if is_covered else image.depth
    found = slam.track(epipole.Frame(float(ride.timestamp_s[n]), gray, depth=depth))
    results.append((n, found))
    if found.world_from_body is None:
        print(f"frame {n}: {found.state.value} ({found.reason})")

# The world frame is the camera of the first frame, so the first pose is the identity.

first = results[0][1]
assert np.allclose(first.world_from_body.as_matrix(), np.eye(4))

# An unknown pose is `None`, never a guess. When the hand is gone, SLAM relocalizes the camera in the map.

localized = {n: found for n, found in results if found.world_from_body is not None}
assert not any(n in localized for n in covered)
assert all(n in localized for n in range(0, len(ride), 2) if n not in covered)
print(f"{len(localized)} of {len(results)} frames are localized")

# Each pose has a covariance of (translation, rotation) in the axes of the camera, in meters and radians.

last = results[-1][1]
sigma = np.sqrt(np.diag(last.covariance))
position_mm, rotation_deg = 1000 * np.linalg.norm(sigma[:3]), np.degrees(np.linalg.norm(sigma[3:]))
print(f"standard deviation of the last pose: {position_mm:.1f} mm, {rotation_deg:.3f} degrees")
assert 0 < np.linalg.norm(sigma[:3]) < 0.05

# After the last frame, `finish` optimizes the map. `trajectory` then returns the optimized poses. The results
# of `track` above are the estimates at the time of each frame.

slam.finish()
trajectory = slam.trajectory()
rows = np.searchsorted(ride.timestamp_s, trajectory.timestamp_s - 1e-6)
truth = ride.world_from_camera[rows]
final = absolute_error(trajectory.world_from_body, truth, "rigid").position
print(trajectory)
print(f"position error of the trajectory: RMS {1000 * final.rmse:.1f} mm, maximum {1000 * final.max:.1f} mm")
assert len(trajectory) == len(localized) and final.rmse < 0.01
from_first = ride.world_from_camera[0].inverse() @ ride.world_from_camera
online_error_m = [
    np.linalg.norm(found.world_from_body.translation - from_first[n].translation)
    for n, found in localized.items()
]
print(f"RMS position error at frame time: {1000 * np.sqrt(np.mean(np.square(online_error_m))):.1f} mm")
assert max(online_error_m) < 0.05 and online_error_m[-1] < 5 * np.linalg.norm(sigma[:3])

# The depth sensor determines the scale: a similarity fitted to the true trajectory has a scale close to one.

scale = float(absolute_error(trajectory.world_from_body, truth, "similarity").truth_from_estimate.scale)
print(f"scale against the truth: {scale:.4f}")
assert abs(scale - 1.0) < 0.02

# `epipole.slam("FOLDER", "OUT")` processes a recording (TUM, EuRoC, KITTI, 7-Scenes, a video) and writes the
# trajectory, the map, covariances and a report. On the command line, `--map OUT` continues in the map of an
# earlier run.
