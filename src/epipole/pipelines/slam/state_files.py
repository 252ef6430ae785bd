"""The state of SLAM on disk, written again and again: what lasts is appended once, the rest is one small sealed file."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np

from epipole._declared.tables import Expected, Table
from epipole.errors import FileFormatError, WorkspaceError
from epipole.io.atomic import reporting
from epipole.io.files import file_bytes
from epipole.io.json_files import json_values
from epipole.pipelines.slam.growing_path import write_all
from epipole.pipelines.slam.state_codec import (
    BadState,
    Coded,
    array_of,
    bytes_of,
    decode,
    encode,
    num_bytes_of,
    table_of,
)
from epipole.runs.units import is_done, load, store, stored_key

STATE, ARRAYS = "state.npz", "arrays-{}.bin"
VERSION = "epipole checkpoint 2"
LEAST_BYTES = 512
"""Smaller arrays are not worth a place of their own."""
SPARE_BYTES = 64_000_000
"""Of arrays that are of no use any more, before those in use are written anew."""
_INLINE = -1
_TABLE: Table = {"text": Expected("uint8", "n"), "inline": Expected("uint8", "m")}


class StateFiles:
    """A state and its arrays in a folder.

    Arrays that are never written to are appended to a file, once: pictures of keyframes at once, others where they are still
    there at the second time that the state is written. A second of SLAM changes little of a large map.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._file: FileIO | None = None
        self._number, self._end = 0, 0
        self._stored: dict[int, tuple[np.ndarray, int, int]] = {}
        """By identity: the array, its place in the file, and its sum."""
        self._seen: dict[int, np.ndarray] = {}
        """Those of the last time that are not in the file."""

    def write(self, value: object, known: Mapping[str, object], facts: Mapping[str, Any]) -> None:
        """Write a state, with a few facts besides, in one step.

        Raises:
            WorkspaceError: the disk is full, or the folder not writable.
        """
        coded = encode(value, known)
        with reporting(self.folder):
            rows, inline = self._placed(coded)
            content = {
                **{"facts": dict(facts), "structure": coded.structure, "arrays": rows},
                **{"file": self._number, "end": self._end},
            }
            text = np.frombuffer(json.dumps(content, separators=(",", ":")).encode(), np.uint8)
            store(self.folder / STATE, VERSION, {"text": text, "inline": np.frombuffer(inline, np.uint8)})
            self._remove_others()

    def read(self, known: Mapping[str, object]) -> tuple[Any, dict[str, Any]]:
        """The state and the facts that were written last; further ones can be written after it.

        Raises:
            FileFormatError: they are damaged, or of another version.
        """
        path = self.folder / STATE
        if not is_done(path, VERSION):
            key = stored_key(path)
            why = f"is of another version ({key})" if key not in ("", VERSION) else "is missing or damaged"
            raise FileFormatError(path, why)
        try:
            held = load(path, _TABLE)
            content = json_values(path, held["text"].tobytes().decode(), allow_nan=True)
            arrays = self._arrays(content, held["inline"].tobytes())
            return decode(Coded(content["structure"], arrays), known), dict(content["facts"])
        except (
            BadState,
            WorkspaceError,
            OSError,
            KeyError,
            TypeError,
            ValueError,
            OverflowError,
            RecursionError,
        ) as error:
            raise FileFormatError(path, f"is damaged: {error}") from error

    def close(self) -> None:
        """Close the file of arrays."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _placed(self, coded: Coded) -> tuple[list[Any], bytes]:
        """(a row for each array, bytes of those that are not in the file)."""
        lasting = {n for n in coded.lasting | coded.pictures if coded.arrays[n].nbytes >= LEAST_BYTES}
        old = {n for n in lasting if id(coded.arrays[n]) in self._stored}
        again = [n for n in sorted(lasting - old) if n in coded.pictures or id(coded.arrays[n]) in self._seen]
        used = sum(coded.arrays[n].nbytes for n in old)
        self._stored = {id(coded.arrays[n]): self._stored[id(coded.arrays[n])] for n in old}
        if self._end - used > max(SPARE_BYTES, used):
            self._begin_anew()
        for n in again:
            self._append(coded.arrays[n])
        self._seen = {id(a): a for n in lasting if id(a := coded.arrays[n]) not in self._stored}
        rows, inline, at = [], [], 0
        for row, array in zip(table_of(coded.arrays), coded.arrays):
            if id(array) in self._stored:
                rows.append([row, *self._stored[id(array)][1:]])
                continue
            rows.append([row, at, _INLINE])
            inline.append(bytes_of(array))
            at += len(inline[-1])
        return rows, b"".join(inline)

    def _append(self, array: np.ndarray) -> None:
        if self._file is None:
            self._file = FileIO(self.folder / ARRAYS.format(self._number), "ab")
            self._file.truncate(self._end)
        data = bytes_of(array)
        write_all(self._file, data)
        self._stored[id(array)] = array, self._end, zlib.crc32(data)
        self._end += len(data)

    def _begin_anew(self) -> None:
        """Another file, with what is still in use."""
        self.close()
        kept = [array for array, _, _ in self._stored.values()]
        self._number, self._end, self._stored = self._number + 1, 0, {}
        (self.folder / ARRAYS.format(self._number)).unlink(missing_ok=True)
        for array in kept:
            self._append(array)

    def _remove_others(self) -> None:
        own = ARRAYS.format(self._number)
        for path in self.folder.glob(ARRAYS.format("*")):
            if path.name != own:
                with suppress(OSError):
                    path.unlink()

    def _arrays(self, content: Any, inline: bytes) -> list[np.ndarray]:
        self._number, self._end = int(content["file"]), int(content["end"])
        path = self.folder / ARRAYS.format(self._number)
        data = file_bytes(path) if self._end else b""
        if not 0 <= self._end <= len(data):
            raise BadState(f"{path.name} is cut off")
        if sum(num_bytes_of(row) for row, _, _ in content["arrays"]) > len(inline) + len(data):
            raise BadState("its arrays are larger than their files")
        out, self._stored, self._seen = [], {}, {}
        for row, at, told in content["arrays"]:
            source = memoryview(inline if told == _INLINE else data)
            if at < 0:
                raise BadState("an array has no place")
            piece = source[at : at + num_bytes_of(row)]
            array = array_of(row, piece)
            if told != _INLINE:
                if zlib.crc32(piece) != told:
                    raise BadState(f"{path.name} is not what was written")
                self._stored[id(array)] = array, at, told
            out.append(array)
        return out
