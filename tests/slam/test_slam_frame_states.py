"""Names of the tracking states, including those in files of earlier versions."""

import pytest

from epipole.pipelines.slam.frames import TrackingState


def test_a_state_of_an_earlier_version_is_read() -> None:
    assert TrackingState("turning") is TrackingState("rotating") is TrackingState.ROTATING
    with pytest.raises(ValueError, match="flying"):
        TrackingState("flying")
