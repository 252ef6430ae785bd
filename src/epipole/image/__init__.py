"""Pictures as arrays: resampling without distortion."""

from epipole.image.undistort import undistort_image as undistort_image
from epipole.image.undistort import undistorted_camera as undistorted_camera
