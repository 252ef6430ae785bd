"""Dense disparity search: matching costs, semi-global paths and blocks, and how sure each disparity is."""

from epipole.disparity_search.config import DisparityConfig as DisparityConfig
from epipole.disparity_search.search import match_stereo as match_stereo
from epipole.disparity_search.search import match_with_evidence as match_with_evidence
