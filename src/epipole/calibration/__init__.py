"""Calibration: cameras and rigs from views of a board, with what is known of their errors."""

from epipole.calibration.board import BoardView as BoardView
from epipole.calibration.board import corners_on_board as corners_on_board
from epipole.calibration.board import find_board as find_board
from epipole.calibration.calibrate import Calibration as Calibration
from epipole.calibration.calibrate import ViewState as ViewState
from epipole.calibration.calibrate import calibrate as calibrate
from epipole.calibration.comparison import cross_check as cross_check
from epipole.calibration.comparison import projection_difference as projection_difference
from epipole.calibration.uncertainty import projection_sigma as projection_sigma
from epipole.config import BoardConfig as BoardConfig
from epipole.config import CalibrationConfig as CalibrationConfig
