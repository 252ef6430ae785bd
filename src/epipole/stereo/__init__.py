"""Dense stereo: disparities of rectified pairs."""

from epipole.config import StereoConfig as StereoConfig
from epipole.stereo.matching import DisparityMap as DisparityMap
from epipole.stereo.matching import StereoReason as StereoReason
from epipole.stereo.matching import match_stereo as match_stereo
