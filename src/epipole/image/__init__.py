"""Pictures as arrays: resampling without distortion, census."""

from epipole.image.census import census as census
from epipole.image.undistort import undistort_image as undistort_image
from epipole.image.undistort import undistorted_camera as undistorted_camera
