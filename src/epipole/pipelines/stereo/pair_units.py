"""Pairs as units of work, which other threads or the machines of a cluster measure. The result of a unit is the files of its pair."""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from epipole._checks.tables import TEXT, Arrays, Expected, Table
from epipole.errors import EpipoleError, WorkspaceError
from epipole.io.json_files import json_text
from epipole.pipelines.stereo.config import StereoConfig
from epipole.pipelines.stereo.measured_pair import measured, summary_of_pair, write_pair
from epipole.pipelines.stereo.pair_files import files_of_pair
from epipole.runs import Unit, digest, load
from epipole.scene import RectifiedRig, StereoRig

UNITS = "units"
"""Folder of the results that are not yet in the folders of their pairs."""
FORMAT = 1
"""Increase when the files of the same pair change."""
FILES: Table = {
    "names": Expected(TEXT, "n"),
    "num_bytes": Expected("int64", "n"),
    "content": Expected("uint8", "m"),
    "summary": Expected(TEXT),
}
"""The files one after the other; without any if the pair cannot be measured."""


@dataclass(frozen=True, slots=True, eq=False)
class PairPayload:
    """Input of the unit of one pair."""

    left: Path
    right: Path
    config: StereoConfig
    rig: RectifiedRig | StereoRig | None


def unit_of_pair(out: Path, payload: PairPayload, settings: dict[str, Any]) -> Unit:
    """The unit of a pair.

    Args:
        out: folder of all pairs.
        payload: images and options.
        settings: everything that the result depends on.
    """
    key = digest("stereo", FORMAT, settings)
    return Unit(out / UNITS / f"{key}.npz", key, measured_files, payload)


def measured_files(payload: PairPayload) -> Arrays:
    """Measure a pair; arrays as in `FILES`.

    There is no file if the pair cannot be measured.

    Raises:
        WorkspaceError: the files cannot be written.
    """
    with tempfile.TemporaryDirectory() as scratch:
        folder, summary = Path(scratch), dict[str, Any]()
        try:
            result = measured(files_of_pair(payload.left, payload.right, payload.rig), payload.config)
            write_pair(result, folder)
            summary = summary_of_pair(result)
        except WorkspaceError:
            raise
        except EpipoleError:
            pass
        paths = sorted(path for path in folder.rglob("*") if path.is_file()) if summary else []
        contents = [np.frombuffer(path.read_bytes(), np.uint8) for path in paths]
        return {
            "names": np.array([path.relative_to(folder).as_posix() for path in paths], str),
            "num_bytes": np.array([content.size for content in contents], np.int64),
            "content": np.concatenate([np.zeros(0, np.uint8), *contents]),
            "summary": np.array(json_text(summary)),
        }


def results_of_unit(unit: Unit) -> tuple[dict[str, bytes], dict[str, Any]]:
    """The files of a pair by name, and its summary; both are empty if the pair could not be measured.

    Raises:
        WorkspaceError: the unit's file is missing or damaged.
    """
    found = load(unit.path, FILES)
    content, ends = found["content"], np.cumsum(found["num_bytes"])
    files = {
        str(name): content[end - size : end].tobytes()
        for name, end, size in zip(found["names"], ends, found["num_bytes"])
    }
    summary: dict[str, Any] = json.loads(str(found["summary"]))
    return files, summary
