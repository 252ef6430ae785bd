"""Rotations, rigid motions, similarities; points and lines; two-view algebra; triangulation; alignment."""

from epipole.geometry.alignment import align_points as align_points
from epipole.geometry.epipolar import choose_by_cheirality as choose_by_cheirality
from epipole.geometry.epipolar import decompose_essential_matrix as decompose_essential_matrix
from epipole.geometry.epipolar import epipolar_lines as epipolar_lines
from epipole.geometry.epipolar import epipoles as epipoles
from epipole.geometry.epipolar import essential_from_cam2_from_cam1 as essential_from_cam2_from_cam1
from epipole.geometry.epipolar import essential_from_fundamental as essential_from_fundamental
from epipole.geometry.epipolar import fundamental_from_essential as fundamental_from_essential
from epipole.geometry.epipolar import sampson_error as sampson_error
from epipole.geometry.homogeneous import from_homogeneous as from_homogeneous
from epipole.geometry.homogeneous import intersection_of as intersection_of
from epipole.geometry.homogeneous import line_through as line_through
from epipole.geometry.homogeneous import point_line_distance as point_line_distance
from epipole.geometry.homogeneous import to_homogeneous as to_homogeneous
from epipole.geometry.planes import PlaneMotions as PlaneMotions
from epipole.geometry.planes import decompose_homography as decompose_homography
from epipole.geometry.rectification import rectifying_homographies as rectifying_homographies
from epipole.geometry.rigid2 import Rigid2 as Rigid2
from epipole.geometry.rigid3 import Rigid3 as Rigid3
from epipole.geometry.rotation3 import Rotation3 as Rotation3
from epipole.geometry.rotation3 import skew as skew
from epipole.geometry.similarity3 import Similarity3 as Similarity3
from epipole.geometry.triangulation import ray_angles_rad as ray_angles_rad
from epipole.geometry.triangulation import triangulate_linear as triangulate_linear
from epipole.geometry.triangulation import triangulate_two_view as triangulate_two_view
