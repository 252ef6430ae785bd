"""Project a point, and back

A camera turns points of space into pixels and pixels into rays. This page fixes the conventions that every
other page uses: camera axes are x right, y down, z forward; a motion is named `target_from_source`; pixel (0,
0) is the *centre* of the top-left pixel.
"""

import numpy as np

import epipole
from epipole.geometry import Rigid3, Rotation3
from epipole.image import undistorted_camera
from epipole.io import params_from_colmap

# A camera is the name of a model, the size of its images and the model's parameters in pixels. The names,
# the order and the coefficients are COLMAP's and OpenCV's.

camera = epipole.Camera("OPENCV", 640, 480, [500, 500, 319.5, 239.5, -0.1, 0.02, 0.001, -0.001])
print(camera)
print("parameters:", ", ".join(camera.model.param_names))

# A point on the optical axis falls on the principal point; one to the right of it falls right, one below it
# falls lower in the image. What is behind the camera has no pixel: NaN, not a mirrored one.

pixels = camera.project([[0, 0, 2], [0.1, 0, 2], [0, 0.1, 2], [0, 0, -2]])
print(pixels.round(2))
assert np.allclose(pixels[0], [319.5, 239.5])
assert pixels[1, 0] > pixels[0, 0] and pixels[2, 1] > pixels[0, 1]
assert np.isnan(pixels[3]).all()

# Back from a pixel there is only a direction, of length one: the depth is lost. With a depth along the
# optical axis the ray is scaled until its z is that depth, and the point is where it was.

points_in_cam = np.array([[0.3, -0.2, 2.0], [-0.5, 0.4, 3.0]])
rays = camera.unproject(camera.project(points_in_cam))
depths = points_in_cam[:, 2:]
assert np.allclose(np.linalg.norm(rays, axis=1), 1.0)
assert np.allclose(rays / rays[:, 2:] * depths, points_in_cam, atol=1e-6)

# Where the camera stands is a motion apart from it. `cam_from_world` takes world coordinates to camera
# coordinates, so the camera's place in the world is the centre of that motion, not its translation.

cam_from_world = Rigid3(Rotation3.exp([0.0, np.deg2rad(30), 0.0]).matrix, np.array([0.2, 0.0, 3.0]))
center_in_world = cam_from_world.centers()
print("camera at", center_in_world.round(3), "and translation", cam_from_world.translation)
assert np.allclose(cam_from_world.apply(center_in_world), 0.0)

# Products of motions read as cancellation: cam2_from_world = cam2_from_cam1 @ cam1_from_world.

cam2_from_cam1 = Rigid3(np.eye(3), np.array([-0.1, 0.0, 0.0]))
cam2_from_world = cam2_from_cam1 @ cam_from_world
point_in_world = np.array([0.1, 0.2, 0.3])
assert np.allclose(
    cam2_from_world.apply(point_in_world), cam2_from_cam1.apply(cam_from_world.apply(point_in_world))
)

# COLMAP counts pixels from the corner of the image, half a pixel more. Readers and writers of its files
# convert by themselves; numbers that are copied by hand need this call.

colmap_params = np.array([500.0, 500.0, 320.0, 240.0])
params = params_from_colmap("PINHOLE", colmap_params)
assert params.tolist() == [500.0, 500.0, 319.5, 239.5]

# A pinhole that sees what the lens saw, for programs that know no distortion: the same ray has another pixel
# in it, and a straight line in space is straight in its images.

pinhole = undistorted_camera(camera)
line = np.stack([np.linspace(-1.0, 1.0, 21), np.full(21, 0.5), np.full(21, 2.0)], axis=1)
bend_px = [np.ptp(each.project(line)[:, 1]) for each in (camera, pinhole)]
print(f"a horizontal edge is bent by {bend_px[0]:.1f} px in the lens, by {bend_px[1]:.0e} px in the pinhole")
assert bend_px[0] > 1.0 and bend_px[1] < 1e-6

# A real camera's parameters come from a calibration: `read_calibration("calibration.json").cameras[0]` of
# `epipole.io.calibration.files`, or `read_colmap_model("OUT/sparse/0").cameras[0]` of `epipole.io`.
