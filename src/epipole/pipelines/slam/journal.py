"""The journal of a run: a line for each frame, on disk before the next one is followed."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from io import FileIO
from pathlib import Path

from epipole.io.atomic import reporting
from epipole.io.files import file_bytes
from epipole.io.json_files import json_values
from epipole.pipelines.slam.growing_path import write_all
from epipole.pipelines.slam.loop_closing import LoopCandidate
from epipole.pipelines.slam.record import FrameRecord
from epipole.pipelines.slam.state_codec import (
    BadState,
    Coded,
    array_of,
    bytes_of,
    decode,
    encode,
    table_of,
)

JOURNAL = "frames.jsonl"


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """A line."""

    record: FrameRecord
    loops: list[LoopCandidate]
    """What was added to the ledger of loops with this frame."""
    end: int
    """Bytes of the file up to this line's end."""
    sum: int
    """Of this line and all before it, so that none can be missing."""


class Journal:
    """Writes the lines. A killed process loses none, for each goes to the system at once."""

    def __init__(self, folder: Path, last: Entry | None = None) -> None:
        """Go on after a line, or begin anew; what follows it is given up.

        Raises:
            WorkspaceError: the file cannot be written.
        """
        self.path = folder / JOURNAL
        with reporting(self.path):
            self._file = FileIO(self.path, "ab")
            self._file.truncate(0 if last is None else last.end)
        self.num_bytes, self._sum = (0, 0) if last is None else (last.end, last.sum)

    def add(self, record: FrameRecord, loops: Sequence[LoopCandidate]) -> None:
        """Add a frame, and what it added to the ledger of loops.

        Raises:
            WorkspaceError: the disk is full.
        """
        coded = encode((record, list(loops)), {})
        rows = [
            [row, base64.b64encode(bytes_of(array)).decode()]
            for row, array in zip(table_of(coded.arrays), coded.arrays)
        ]
        text = json.dumps([coded.structure, rows], separators=(",", ":")).encode()
        self._sum = zlib.crc32(text, self._sum)
        line = b"%08x %b\n" % (self._sum, text)
        with reporting(self.path):
            write_all(self._file, line)
        self.num_bytes += len(line)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_journal(path: Path) -> list[Entry]:
    """The frames of a journal up to the first line that is damaged or of an earlier frame: a killed process, or a full disk, cuts the last one.

    Raises:
        FileFormatError: there is no such file.
    """
    out: list[Entry] = []
    end = before = 0
    for line in file_bytes(path).splitlines(keepends=True):
        try:
            entry = _entry_of(path, line, end + len(line), before)
        except (BadState, ValueError):
            break
        if out and entry.record.number <= out[-1].record.number:
            break
        out.append(entry)
        end, before = entry.end, entry.sum
    return out


def _entry_of(path: Path, line: bytes, end: int, before: int) -> Entry:
    told, _, text = line.rstrip(b"\n").partition(b" ")
    if not line.endswith(b"\n") or int(told, 16) != zlib.crc32(text, before):
        raise BadState("it is cut off")
    try:
        structure, rows = json_values(path, text.decode(), allow_nan=True)
        arrays = [array_of(row, base64.b64decode(data, validate=True)) for row, data in rows]
    except (TypeError, RecursionError) as error:
        raise BadState(str(error)) from error
    found = decode(Coded(structure, arrays), {})
    if not isinstance(found, tuple) or len(found) != 2:
        raise BadState("it holds no frame")
    record, loops = found
    if not isinstance(record, FrameRecord) or not isinstance(loops, list):
        raise BadState("it holds no frame")
    if not all(isinstance(loop, LoopCandidate) for loop in loops):
        raise BadState("it holds no frame")
    return Entry(record, loops, end, int(told, 16))
