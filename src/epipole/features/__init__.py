"""Features: detection, description, matching, tracking, retrieval."""

from epipole.config import FeatureConfig as FeatureConfig
from epipole.config import FlowConfig as FlowConfig
from epipole.config import MatchConfig as MatchConfig
from epipole.features.detect import detect_features as detect_features
from epipole.features.features import Features as Features
from epipole.features.flow import track_points as track_points
from epipole.features.match import match_along_epipolar_lines as match_along_epipolar_lines
from epipole.features.match import match_descriptors as match_descriptors
from epipole.features.patches import align_patches as align_patches
from epipole.features.patches import find_along_rows as find_along_rows
from epipole.features.patches import find_patches as find_patches
from epipole.features.retrieve import describe_image as describe_image
from epipole.features.retrieve import most_similar as most_similar
from epipole.features.retrieve import train_vocabulary as train_vocabulary
from epipole.features.sift import describe_upright as describe_upright
from epipole.features.sift import root_sift as root_sift
