"""Dense stereo: disparities of rectified pairs."""

from epipole.config import StereoConfig as StereoConfig
from epipole.stereo.calibration_error import calibration_sigma as calibration_sigma
from epipole.stereo.depth import DepthMap as DepthMap
from epipole.stereo.depth import RectifiedRig as RectifiedRig
from epipole.stereo.depth import depth_of as depth_of
from epipole.stereo.depth import point_covariances as point_covariances
from epipole.stereo.matching import DisparityMap as DisparityMap
from epipole.stereo.matching import StereoReason as StereoReason
from epipole.stereo.matching import match_stereo as match_stereo
from epipole.stereo.rectification import Rectification as Rectification
from epipole.stereo.rectification import rectify as rectify
from epipole.stereo.uncalibrated import UncalibratedRectification as UncalibratedRectification
from epipole.stereo.uncalibrated import rectify_uncalibrated as rectify_uncalibrated
