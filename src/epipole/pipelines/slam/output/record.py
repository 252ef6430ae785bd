"""Records of the frames: tracking result, image name and time."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole.pipelines.slam.frames import TrackedFrame

LEFT_OUT = "left out"
"""State of a frame that could not be read or did not fit."""
COLUMNS = ("frame", "timestamp_s", "image", "state", "has_pose", "keyframe", "points", "ms", "reason")


@dataclass(frozen=True, slots=True, eq=False)
class FrameRecord:
    """One frame of the source."""

    number: int
    """Number in the source, from 0."""
    name: str
    """Image name."""
    seconds: float
    """Tracking time, without reading files."""
    answer: TrackedFrame | None
    """None if the frame was left out."""
    problem: str = ""
    """Why the frame was left out."""

    @property
    def state(self) -> str:
        """Tracking state, or `LEFT_OUT`."""
        return LEFT_OUT if self.answer is None else self.answer.state.value

    @property
    def reason(self) -> str:
        """Why the frame has no pose, why it is a keyframe, or what is odd about it; empty if there is nothing to report."""
        if self.answer is None:
            return self.problem
        if self.answer.submap_from_body is None:
            return self.answer.reason
        return "; ".join(filter(None, [f"tracked in map {self.answer.map_number + 1}", self.answer.reason]))

    @property
    def sigma_position(self) -> float:
        """Standard deviation of the position, from the frame's own points; NaN if unknown."""
        if self.answer is None or self.answer.covariance is None:
            return float("nan")
        variance = float(np.trace(self.answer.covariance[:3, :3]))
        return float(np.sqrt(variance)) if 0 < variance < np.inf else float("nan")


def write_records(records: Sequence[FrameRecord], path: Path) -> None:
    """Write a CSV table with the result of each frame as estimated when it arrived."""
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for record in records:
            answer = record.answer
            given = ["", LEFT_OUT, 0, 0, 0]
            if answer is not None:
                has_pose = int(answer.world_from_body is not None)
                given = [
                    f"{answer.timestamp_s:.9f}",
                    answer.state.value,
                    has_pose,
                    int(answer.is_keyframe),
                    answer.num_points,
                ]
            row = [
                record.number,
                given[0],
                record.name,
                *given[1:],
                f"{1e3 * record.seconds:.3f}",
                record.reason,
            ]
            table.writerow(row)


def without_numbers(reason: str) -> str:
    """The reason with # for each number, to group reasons that differ only in numbers."""
    return re.sub(r"\d+(\.\d+)?", "#", reason)


@dataclass(frozen=True, slots=True)
class Stretch:
    """Consecutive frames with the same state and reason."""

    first: int
    last: int
    state: str
    reason: str
    """Reason of the last frame; its numbers may differ from those of the others."""

    @property
    def count(self) -> int:
        """Number of frames."""
        return self.last - self.first + 1


def stretches(records: Sequence[FrameRecord]) -> list[Stretch]:
    """Group consecutive frames by state and, if they have no pose, by reason (ignoring numbers)."""
    out: list[Stretch] = []
    words = ""
    for record in records:
        has_pose = record.answer is not None and record.answer.world_from_body is not None
        reason = "" if has_pose else record.reason
        if record.answer is not None and record.answer.submap_from_body is not None:
            reason = reason.split("; ")[0]
        now = without_numbers(reason)
        if out and out[-1].state == record.state and words == now:
            out[-1] = Stretch(out[-1].first, record.number, record.state, reason)
        else:
            out.append(Stretch(record.number, record.number, record.state, reason))
        words = now
    return out
