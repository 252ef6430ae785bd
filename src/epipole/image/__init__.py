"""Images as arrays: gray images, undistortion, downscaling, color maps, census."""

from epipole.image.census import census as census
from epipole.image.color_map import color_map as color_map
from epipole.image.color_map import color_range as color_range
from epipole.image.gray import gray_image as gray_image
from epipole.image.scaling import downscaled as downscaled
from epipole.image.stmaps import distortion_stmap as distortion_stmap
from epipole.image.stmaps import undistortion_stmap as undistortion_stmap
from epipole.image.undistort import undistort_image as undistort_image
from epipole.image.undistort import undistort_points as undistort_points
from epipole.image.undistort import undistorted_camera as undistorted_camera
