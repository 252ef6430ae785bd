"""Dense stereo: disparities of rectified pairs."""

from epipole.config import StereoConfig as StereoConfig
from epipole.stereo.depth import DepthMap as DepthMap
from epipole.stereo.depth import RectifiedRig as RectifiedRig
from epipole.stereo.depth import depth_of as depth_of
from epipole.stereo.depth import point_covariances as point_covariances
from epipole.stereo.matching import DisparityMap as DisparityMap
from epipole.stereo.matching import StereoReason as StereoReason
from epipole.stereo.matching import match_stereo as match_stereo
