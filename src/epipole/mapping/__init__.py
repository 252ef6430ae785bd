"""Building blocks of the mappers: components, the growing model, resection, pose refinement, adjustment."""

from epipole.mapping.adjustment import Freedom as Freedom
from epipole.mapping.adjustment import PositionPriors as PositionPriors
from epipole.mapping.adjustment import adjust_all as adjust_all
from epipole.mapping.adjustment import adjust_around as adjust_around
from epipole.mapping.consistency import MatchConsistency as MatchConsistency
from epipole.mapping.match_components import FurtherMatches as FurtherMatches
from epipole.mapping.match_components import MatchComponents as MatchComponents
from epipole.mapping.match_components import connect_matches as connect_matches
from epipole.mapping.model_builder import ModelBuilder as ModelBuilder
from epipole.mapping.model_builder import Snapshot as Snapshot
from epipole.mapping.pair_consistency import PairConsistency as PairConsistency
from epipole.mapping.pair_consistency import check_rotation_cycles as check_rotation_cycles
from epipole.mapping.pose_refinement import Disparities as Disparities
from epipole.mapping.pose_refinement import RefinedPose as RefinedPose
from epipole.mapping.pose_refinement import refine_pose as refine_pose
from epipole.mapping.readjustment import adjust_reconstruction as adjust_reconstruction
from epipole.mapping.readjustment import bundle_problem_of as bundle_problem_of
from epipole.mapping.resection import refine_resection as refine_resection
from epipole.mapping.resection import resect_image as resect_image
from epipole.mapping.track_completion import drop_short_tracks as drop_short_tracks
from epipole.mapping.track_completion import find_further_matches as find_further_matches
from epipole.mapping.track_completion import median_error_px as median_error_px
