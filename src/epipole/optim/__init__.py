"""Optimization: robust losses, bundle adjustment and pose graphs."""

from epipole.optim.bundle_adjustment import BundleConfig as BundleConfig
from epipole.optim.bundle_adjustment import BundleIteration as BundleIteration
from epipole.optim.bundle_adjustment import BundleResult as BundleResult
from epipole.optim.bundle_adjustment import StopReason as StopReason
from epipole.optim.bundle_adjustment import adjust_bundle as adjust_bundle
from epipole.optim.bundle_adjustment import with_result as with_result
from epipole.optim.bundle_covariance import BundleCovariance as BundleCovariance
from epipole.optim.bundle_covariance import bundle_covariance as bundle_covariance
from epipole.optim.bundle_covariance import bundle_variance as bundle_variance
from epipole.optim.bundle_problem import BundlePriors as BundlePriors
from epipole.optim.bundle_problem import BundleProblem as BundleProblem
from epipole.optim.bundle_problem import PathFactors as PathFactors
from epipole.optim.bundle_problem import PointDistances as PointDistances
from epipole.optim.bundle_problem import PointPositions as PointPositions
from epipole.optim.bundle_problem import free_params_mask as free_params_mask
from epipole.optim.bundle_problem import with_fixed_gauge as with_fixed_gauge
from epipole.optim.bundle_system import LinearSolver as LinearSolver
from epipole.optim.losses import Loss as Loss
from epipole.optim.losses import evaluate_loss as evaluate_loss
from epipole.optim.pose_graph import PoseGraph as PoseGraph
from epipole.optim.pose_graph import PoseGraphConfig as PoseGraphConfig
from epipole.optim.pose_graph import PoseGraphResult as PoseGraphResult
from epipole.optim.pose_graph import initialize_pose_graph as initialize_pose_graph
from epipole.optim.pose_graph import optimize_pose_graph as optimize_pose_graph
from epipole.optim.pose_graph import pose_graph_cost as pose_graph_cost
from epipole.optim.robust_pose_graph import optimize_pose_graph_robustly as optimize_pose_graph_robustly
