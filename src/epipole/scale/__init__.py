"""Metric scale: evidence from known positions, lengths, odometry, IMUs and objects."""

from epipole.scale.anchor_views import AnchorViews as AnchorViews
from epipole.scale.anchor_views import position_covariance as position_covariance
from epipole.scale.anchor_views import views_of_model as views_of_model
from epipole.scale.anchoring import Anchoring as Anchoring
from epipole.scale.anchoring import after_adjustment as after_adjustment
from epipole.scale.anchoring import anchor_model as anchor_model
from epipole.scale.inertial_scale import fit_scale_to_imu as fit_scale_to_imu
from epipole.scale.known_objects import ObjectFit as ObjectFit
from epipole.scale.known_objects import fit_scale_to_object as fit_scale_to_object
from epipole.scale.metric_scale import ScaleFit as ScaleFit
from epipole.scale.metric_scale import fit_scale_to_positions as fit_scale_to_positions
from epipole.scale.scale_agreement import MetricScale as MetricScale
from epipole.scale.scale_agreement import ScaleEstimate as ScaleEstimate
from epipole.scale.scale_agreement import agreed_scale as agreed_scale
from epipole.scale.scale_evidence import check_anchor_files as check_anchor_files
from epipole.scale.scale_evidence import mounted_imu as mounted_imu
from epipole.scale.traveled_scale import fit_scale_to_distances as fit_scale_to_distances
