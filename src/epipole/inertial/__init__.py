"""IMUs: preintegration, and the scale and gravity of a trajectory from an IMU."""

from epipole.inertial.alignment import InertialAlignment as InertialAlignment
from epipole.inertial.alignment import align_path_to_imu as align_path_to_imu
from epipole.inertial.factors import ImuFactors as ImuFactors
from epipole.inertial.factors import imu_factors as imu_factors
from epipole.inertial.log import ImuLog as ImuLog
from epipole.inertial.log import ImuNoise as ImuNoise
from epipole.inertial.log import MountedImu as MountedImu
from epipole.inertial.preintegration import Preintegrated as Preintegrated
from epipole.inertial.preintegration import preintegrate as preintegrate
