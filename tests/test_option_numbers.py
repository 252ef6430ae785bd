"""Numbers in options that nothing can be calculated with are refused, whichever option it is."""

from dataclasses import fields, replace

import pytest

from epipole.config import AnchorOptions, BoardConfig, FeatureConfig, MatchConfig, RansacConfig
from epipole.disparity_search.config import DisparityConfig
from epipole.errors import ConfigError
from epipole.features import FlowConfig
from epipole.fields.config import NerfTraining, SplatTraining
from epipole.optim import BundleConfig, PoseGraphConfig
from epipole.pipelines.calibration.config import CalibrationConfig
from epipole.pipelines.fields.config import FieldOptions, MeshConfig, RenderConfig
from epipole.pipelines.sfm.config import MapperConfig, PairingConfig, ReconstructConfig
from epipole.pipelines.slam.config import CameraOptions, JobOptions, SlamConfig
from epipole.pipelines.stereo.config import RigOptions, StereoConfig

CONFIGS = (
    *(AnchorOptions, BoardConfig, BundleConfig, CalibrationConfig, CameraOptions, DisparityConfig),
    *(
        FeatureConfig,
        FieldOptions,
        FlowConfig,
        JobOptions,
        MapperConfig,
        MatchConfig,
        MeshConfig,
        NerfTraining,
    ),
    *(PairingConfig, PoseGraphConfig, RansacConfig, ReconstructConfig, RenderConfig, RigOptions, SlamConfig),
    *(SplatTraining, StereoConfig),
)
MAY_BE_NEGATIVE = {"min_disparity_px", "max_disparity_px", "rotation_deg", "principal_offset_px"}
MAY_BE_INFINITE = {
    "max_error_px",
    "max_distance",
    "edge_fade",
    "max_left_right_px",
    "max_sigma_px",
    "min_margin",
}


def numbers_of(kind):
    for field in fields(kind):
        words = str(field.type).split("|")
        name = next((word.strip() for word in words if word.strip() in ("int", "float")), None)
        if name:
            yield field.name, name


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", CONFIGS, ids=lambda kind: kind.__name__)
def test_no_number_is_taken_that_cannot_be_calculated_with(kind):
    taken = []
    for name, number in numbers_of(kind):
        values = [float("nan"), "1", 10**30, -(10**30), 1e308]
        values += [2**62] if number == "int" and "seed" not in name else []
        values += [] if name in MAY_BE_NEGATIVE else [-1, -(2**31)]
        values += [5e-324, 1e-308] if number == "float" else [0.5]
        values += [] if name in MAY_BE_INFINITE else [float("inf"), float("-inf")]
        for value in values:
            if number == "float" and (value == 10**30 or (value == -(10**30) and name in MAY_BE_NEGATIVE)):
                continue  # large, and a number
            try:
                replace(kind(), **{name: value})
            except ConfigError as error:
                assert str(error)
            else:
                taken.append((name, value))
    assert not taken
