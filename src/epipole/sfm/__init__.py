"""Structure-from-motion: from photographs to models."""

from epipole.sfm.pipeline import PipelineResult as PipelineResult
from epipole.sfm.pipeline import run_pipeline as run_pipeline
