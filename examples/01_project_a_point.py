"""Project points to pixels and back

A camera model maps points to pixels and pixels to viewing rays. This page also introduces the conventions of
all other pages: camera axes are x right, y down and z forward; a motion is named `target_from_source`; pixel
(0, 0) is the *center* of the top-left pixel.
"""

import numpy as np

import epipole
from epipole.geometry import Rigid3, Rotation3
from epipole.image import undistorted_camera
from epipole.io import params_from_colmap

# A `Camera` has a model name, an image size and the parameters of the model in pixels. Model names, parameter
# order and distortion coefficients are the same as in COLMAP and OpenCV.

camera = epipole.Camera("OPENCV", 640, 480, [500, 500, 319.5, 239.5, -0.1, 0.02, 0.001, -0.001])
print(camera)
print("parameters:", ", ".join(camera.model.param_names))

# A point on the optical axis projects to the principal point. A point to its right projects further right in
# the image, and a point below it projects further down. A point behind the camera has no pixel, so `project`
# returns NaN.

pixels = camera.project([[0, 0, 2], [0.1, 0, 2], [0, 0.1, 2], [0, 0, -2]])
print(pixels.round(2))
assert np.allclose(pixels[0], [319.5, 239.5])
assert pixels[1, 0] > pixels[0, 0] and pixels[2, 1] > pixels[0, 1]
assert np.isnan(pixels[3]).all()

# `unproject` returns a ray of length one, because a pixel does not determine the depth. If the depth along
# the optical axis is known, scale the ray until its z equals that depth.

points_in_cam = np.array([[0.3, -0.2, 2.0], [-0.5, 0.4, 3.0]])
rays = camera.unproject(camera.project(points_in_cam))
depths = points_in_cam[:, 2:]
assert np.allclose(np.linalg.norm(rays, axis=1), 1.0)
assert np.allclose(rays / rays[:, 2:] * depths, points_in_cam, atol=1e-6)

# The pose is separate from the camera. `cam_from_world` maps world coordinates to camera coordinates. The
# position of the camera in the world is `cam_from_world.centers()`, not `cam_from_world.translation`.

cam_from_world = Rigid3(Rotation3.exp([0.0, np.deg2rad(30), 0.0]).matrix, np.array([0.2, 0.0, 3.0]))
center_in_world = cam_from_world.centers()
print("camera position", center_in_world.round(3), "translation", cam_from_world.translation)
assert np.allclose(cam_from_world.apply(center_in_world), 0.0)

# In a product of motions, adjacent names cancel: cam2_from_world = cam2_from_cam1 @ cam1_from_world.

cam2_from_cam1 = Rigid3(np.eye(3), np.array([-0.1, 0.0, 0.0]))
cam2_from_world = cam2_from_cam1 @ cam_from_world
point_in_world = np.array([0.1, 0.2, 0.3])
assert np.allclose(
    cam2_from_world.apply(point_in_world), cam2_from_cam1.apply(cam_from_world.apply(point_in_world))
)

# COLMAP puts the origin at the corner of the image, so its pixel coordinates are larger by 0.5. The readers
# and writers of COLMAP files convert them. Call `params_from_colmap` for numbers that you copy by hand.

colmap_params = np.array([500.0, 500.0, 320.0, 240.0])
params = params_from_colmap("PINHOLE", colmap_params)
assert params.tolist() == [500.0, 500.0, 319.5, 239.5]

# `undistorted_camera` returns a pinhole camera with the same focal length for programs that do not support
# distortion. A ray has a different pixel in each of the two cameras. A straight line in space is straight in
# the pinhole image.

pinhole = undistorted_camera(camera)
line = np.stack([np.linspace(-1.0, 1.0, 21), np.full(21, 0.5), np.full(21, 2.0)], axis=1)
bend_px = [np.ptp(each.project(line)[:, 1]) for each in (camera, pinhole)]
print(f"bend of a horizontal line: {bend_px[0]:.1f} px with distortion, {bend_px[1]:.0e} px without")
assert bend_px[0] > 1.0 and bend_px[1] < 1e-6

# The parameters of a real camera come from a calibration or from a reconstruction. Read them with
# `read_calibration("calibration.json").cameras[0]` of `epipole.io.calibration.files`, or with
# `read_colmap_model("OUT/sparse/0").cameras[0]` of `epipole.io`.
