"""Minimal and linear solvers for single geometric problems, on plain arrays."""

from epipole.solvers.absolute_pose import FocalPoses as FocalPoses
from epipole.solvers.absolute_pose import solve_generalized_p3p as solve_generalized_p3p
from epipole.solvers.absolute_pose import solve_p3p as solve_p3p
from epipole.solvers.absolute_pose import solve_p4pf as solve_p4pf
from epipole.solvers.absolute_pose import solve_pnp as solve_pnp
from epipole.solvers.absolute_pose import solve_upright_p2p as solve_upright_p2p
from epipole.solvers.two_view import SharedFocals as SharedFocals
from epipole.solvers.two_view import solve_essential_five_point as solve_essential_five_point
from epipole.solvers.two_view import solve_fundamental_eight_point as solve_fundamental_eight_point
from epipole.solvers.two_view import solve_fundamental_seven_point as solve_fundamental_seven_point
from epipole.solvers.two_view import solve_homography_dlt as solve_homography_dlt
from epipole.solvers.two_view import solve_homography_four_point as solve_homography_four_point
from epipole.solvers.two_view import solve_shared_focal_six_point as solve_shared_focal_six_point
from epipole.solvers.two_view import (
    solve_upright_relative_three_point as solve_upright_relative_three_point,
)
