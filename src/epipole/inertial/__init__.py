"""IMUs: preintegration, and the scale and gravity of a trajectory from an IMU."""

from epipole.inertial.alignment import InertialAlignment as InertialAlignment
from epipole.inertial.alignment import align_path_to_imu as align_path_to_imu
from epipole.inertial.clock import ImuClock as ImuClock
from epipole.inertial.clock import fit_imu_clock as fit_imu_clock
from epipole.inertial.dead_reckoning import ImuCalibration as ImuCalibration
from epipole.inertial.dead_reckoning import ImuMotion as ImuMotion
from epipole.inertial.dead_reckoning import carry_motion as carry_motion
from epipole.inertial.dead_reckoning import fit_imu_motion as fit_imu_motion
from epipole.inertial.factors import ImuFactors as ImuFactors
from epipole.inertial.factors import imu_factors as imu_factors
from epipole.inertial.log import ImuBuffer as ImuBuffer
from epipole.inertial.log import ImuLog as ImuLog
from epipole.inertial.log import ImuNoise as ImuNoise
from epipole.inertial.log import MountedImu as MountedImu
from epipole.inertial.preintegration import Preintegrated as Preintegrated
from epipole.inertial.preintegration import preintegrate as preintegrate
