"""The state of SLAM as it was written last, and what was followed since by a process that is gone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from epipole.errors import FileFormatError
from epipole.pipelines.slam.checkpoint import known_to
from epipole.pipelines.slam.frames import TrackedFrame, TrackingState
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.starting import OneCameraStart
from epipole.pipelines.slam.state_checks import problem_of_state
from epipole.pipelines.slam.state_files import STATE, StateFiles

State = dict[str, Any]
"""The attributes of a `Slam`, without the entries of its ledger of loops."""


class Restored(NamedTuple):
    """A state, and the part of the journal that it has seen."""

    state: State
    num_lines: int
    num_bytes: int


def read_state(system: Slam, files: StateFiles) -> Restored:
    """The state that was written last.

    Args:
        system: of the same camera and options, whose attributes these can become.
        files: where it was written.

    Raises:
        FileFormatError: what is there is damaged.
    """
    path = files.folder / STATE
    held, facts = files.read(known_to(system))
    if not isinstance(held, dict) or set(held) != set(vars(system)):
        raise FileFormatError(path, "is of another version")
    try:
        num_lines, num_bytes = int(facts["num_lines"]), int(facts["num_bytes"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FileFormatError(path, "is damaged: it does not tell its frames") from error
    problem = problem_of_state(held, system, num_lines)
    if problem:
        raise FileFormatError(path, f"is damaged: {problem}")
    return Restored(held, num_lines, num_bytes)


def go_on_after(state: State, missed: Sequence[TrackedFrame]) -> None:
    """Let the answers stand that were given since, by a map that is gone; the camera is to be sought in this one.

    Args:
        state: is changed.
        missed: what was known of the frames since then.
    """
    keyframe = next((k for k in reversed(state["maps"][0].keyframes) if len(k.point)), None)
    for answer in missed:
        place, covariance = answer.world_from_body, answer.covariance
        if place is not None and covariance is not None and keyframe is not None:
            told = place.inverse(), covariance
            state["_path"].add(state["_num_frames"], answer.timestamp_s, keyframe, *told)
        state["_num_frames"] += 1
    if missed and state["_before"] is not None:  # what comes next is later than all of them
        state["_before"] = replace(state["_before"], timestamp_s=missed[-1].timestamp_s)
    state["_start"] = OneCameraStart(state["camera"].camera, state["config"])
    state["_turning"] = state["_unconfirmed"] = None
    state["_closer"].forget()
    if state["map"].num_points:
        state["state"], state["_num_lost"] = TrackingState.LOST, 1
