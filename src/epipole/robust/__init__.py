"""Robust estimation: the LO-RANSAC loop, its estimators, and pair verification."""

from epipole.config import RansacConfig as RansacConfig
from epipole.robust.absolute_pose import FocalPose as FocalPose
from epipole.robust.absolute_pose import estimate_absolute_pose as estimate_absolute_pose
from epipole.robust.absolute_pose import estimate_pose_and_focal as estimate_pose_and_focal
from epipole.robust.absolute_pose import estimate_rig_pose as estimate_rig_pose
from epipole.robust.absolute_pose import estimate_upright_pose as estimate_upright_pose
from epipole.robust.alignment import estimate_rigid as estimate_rigid
from epipole.robust.alignment import estimate_similarity as estimate_similarity
from epipole.robust.alignment import estimate_upright_similarity as estimate_upright_similarity
from epipole.robust.estimate import Estimate as Estimate
from epipole.robust.estimate import Reason as Reason
from epipole.robust.pairs.focal_motion import FocalMotion as FocalMotion
from epipole.robust.pairs.focal_motion import estimate_motion_and_focals as estimate_motion_and_focals
from epipole.robust.pairs.focal_motion import (
    estimate_motion_and_shared_focal as estimate_motion_and_shared_focal,
)
from epipole.robust.pairs.kind import PairKind as PairKind
from epipole.robust.pairs.two_view import estimate_essential_matrix as estimate_essential_matrix
from epipole.robust.pairs.two_view import estimate_fundamental_matrix as estimate_fundamental_matrix
from epipole.robust.pairs.two_view import estimate_homography as estimate_homography
from epipole.robust.pairs.two_view import estimate_relative_pose as estimate_relative_pose
from epipole.robust.pairs.two_view import estimate_upright_motion as estimate_upright_motion
from epipole.robust.pairs.verify import PairGeometry as PairGeometry
from epipole.robust.pairs.verify import PairMatches as PairMatches
from epipole.robust.pairs.verify import verify_pair as verify_pair
from epipole.robust.pairs.verify import verify_pairs as verify_pairs
from epipole.robust.triangulate import PointReason as PointReason
from epipole.robust.triangulate import Triangulation as Triangulation
from epipole.robust.triangulate import point_covariances as point_covariances
from epipole.robust.triangulate import triangulate_points as triangulate_points
