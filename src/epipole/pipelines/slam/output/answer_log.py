"""Log of a live run: one JSON line per frame with the result estimated when the frame arrived."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from epipole.errors import EpipoleError, FileFormatError
from epipole.geometry import Rigid3
from epipole.io.files import file_bytes
from epipole.io.json_files import json_values
from epipole.pipelines.slam.frames import TrackedFrame, TrackingState
from epipole.pipelines.slam.output.record import FrameRecord

ANSWERS = "frames.jsonl"
_ROTATION_TOLERANCE = 1e-6


def line_of(record: FrameRecord) -> bytes:
    """One line of the log: a checksum and JSON. Poses in separate maps and moving objects are not stored."""
    answer = record.answer
    content: dict[str, Any] = {
        "number": record.number,
        "name": record.name,
        "seconds": record.seconds,
        "problem": record.problem,
        "answer": None,
    }
    if answer is not None:
        pose = answer.world_from_body
        content["answer"] = {
            "timestamp_s": answer.timestamp_s,
            "state": answer.state.value,
            "reason": answer.reason,
            "rotation": None if pose is None else pose.rotation.tolist(),
            "translation": None if pose is None else pose.translation.tolist(),
            "covariance": None if answer.covariance is None else answer.covariance.tolist(),
            "num_points": answer.num_points,
            "is_keyframe": answer.is_keyframe,
            "map_number": answer.map_number,
        }
    text = json.dumps(content, separators=(",", ":")).encode()
    return b"%08x %b\n" % (zlib.crc32(text), text)


def read_answers(path: Path) -> list[FrameRecord]:
    """Read the frames of a log; a truncated last line (killed process, full disk) is ignored.

    Raises:
        FileFormatError: the file does not exist, or a line before the last one is damaged or out of order.
    """
    out: list[FrameRecord] = []
    time_s = -np.inf
    lines = file_bytes(path).splitlines()
    for number, line in enumerate(lines, 1):
        try:
            record = _record_of(path, line)
            time_s = _time_after(record, out[-1].number if out else -1, time_s)
        except (EpipoleError, KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
            if number == len(lines):
                break
            raise FileFormatError(path, f"line {number} is damaged ({error})") from error
        out.append(record)
    return out


def _time_after(record: FrameRecord, number: int, time_s: float) -> float:
    """Check that the frame is later than the previous one; returns the timestamp of the last tracked frame."""
    if record.number <= number:
        raise ValueError("the frame number does not increase")
    if record.answer is None:
        return time_s
    if record.answer.timestamp_s <= time_s:
        raise ValueError("the timestamp does not increase")
    return record.answer.timestamp_s


def _record_of(path: Path, line: bytes) -> FrameRecord:
    """Parse one line and check every value: a valid checksum does not make the content trustworthy."""
    checksum, _, text = line.partition(b" ")
    if int(checksum, 16) != zlib.crc32(text):
        raise ValueError("the checksum does not match")
    content = json_values(path, text.decode(), allow_nan=True)
    seconds, problem = float(content["seconds"]), _text(content["problem"])
    answer = None if content["answer"] is None else _answer_of(content["answer"])
    return FrameRecord(_count(content["number"]), _text(content["name"]), seconds, answer, problem)


def _answer_of(content: Any) -> TrackedFrame:
    timestamp_s = float(content["timestamp_s"])
    if not np.isfinite(timestamp_s):
        raise ValueError("the timestamp is not finite")
    covariance = None if content["covariance"] is None else np.array(content["covariance"], np.float64)
    if covariance is not None and covariance.shape != (6, 6):
        raise ValueError("a covariance must be 6 x 6")
    return TrackedFrame(
        timestamp_s=timestamp_s,
        state=TrackingState(content["state"]),
        reason=_text(content["reason"]),
        world_from_body=None
        if content["rotation"] is None
        else _pose(content["rotation"], content["translation"]),
        covariance=covariance,
        num_points=_count(content["num_points"]),
        is_keyframe=content["is_keyframe"] is True,
        map_number=_count(content["map_number"]),
    )


def _pose(rotation: Any, translation: Any) -> Rigid3:
    matrix, vector = np.array(rotation, np.float64), np.array(translation, np.float64)
    if matrix.shape != (3, 3) or vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError("a pose must be a 3 x 3 rotation and a finite translation of 3 values")
    if not np.allclose(matrix @ matrix.T, np.eye(3), atol=_ROTATION_TOLERANCE) or np.linalg.det(matrix) < 0:
        raise ValueError("the 3 x 3 matrix is not a rotation")
    return Rigid3(matrix, vector)


def _count(value: Any) -> int:
    if type(value) is not int or not 0 <= value < 1 << 53:
        raise ValueError("expected a non-negative integer")
    return value


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError("expected a string")
    return value
