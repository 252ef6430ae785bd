"""Errors against ground truth: cameras after alignment, relative poses, trajectories, areas under recall curves."""

from epipole.metrics.cameras import CameraAlignment as CameraAlignment
from epipole.metrics.cameras import CameraErrors as CameraErrors
from epipole.metrics.cameras import align_cameras as align_cameras
from epipole.metrics.cameras import camera_errors as camera_errors
from epipole.metrics.relative_pose import area_under_recall as area_under_recall
from epipole.metrics.relative_pose import relative_pose_auc as relative_pose_auc
from epipole.metrics.relative_pose import relative_pose_errors_deg as relative_pose_errors_deg
from epipole.metrics.trajectories import Alignment as Alignment
from epipole.metrics.trajectories import DriftPerLength as DriftPerLength
from epipole.metrics.trajectories import ErrorStatistics as ErrorStatistics
from epipole.metrics.trajectories import TrajectoryError as TrajectoryError
from epipole.metrics.trajectories import absolute_error as absolute_error
from epipole.metrics.trajectories import associate as associate
from epipole.metrics.trajectories import drift_per_length as drift_per_length
from epipole.metrics.trajectories import relative_error as relative_error
from epipole.metrics.trajectory_scores import TrajectoryEvaluation as TrajectoryEvaluation
from epipole.metrics.trajectory_scores import TrajectoryScore as TrajectoryScore
from epipole.metrics.trajectory_scores import score_trajectory as score_trajectory
