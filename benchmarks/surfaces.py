"""Dense reconstruction (`epipole surface`) against exact depth, a depth camera and other programs: `python -m benchmarks.surfaces`.

- depth: depth of each view of three rendered scenes: right and wrong pixels, standard deviations, time.
- real: depth of color images of a kitchen (7-Scenes) against the depth camera beside them.
- stereo: a view with one source against `match_stereo`, on pairs of Middlebury.
- cloud: precision, recall and F-score of the fused cloud and of the mesh.
- texture: held-out views rendered from the textured mesh, beside splats trained for a minute.
- memory: peak memory on images of 12 megapixels.
- patch match: PatchMatch with slanted windows, which was not chosen, beside the depth of `epipole surface`: half an hour.
- survey: height models and orthophotos of rendered drone flights.
- survey peers: pyOrthomosaic on the same photographs, in a Python that has it (`--orthomosaic-python`).
- peers: Open3D's TSDF and Poisson surfaces of the same depths, in a Python that has Open3D (`--open3d-python`).

The courtyard is in-sample: it was used while the code was written. The other two scenes, the kitchen and the pairs were not. Times depend on
other work of the machine.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.surface_depth import depth_part, fit_shared, real_part, stereo_part
from benchmarks.surface_patch_match import patch_match_part
from benchmarks.surface_shapes import cloud_part, memory_part, peers_part
from benchmarks.surface_survey import survey_part, survey_peers_part
from benchmarks.surface_texture import texture_part
from benchmarks.tasks.sfm import data_root
from epipole import _parallel

RESULTS = REPOSITORY / "benchmarks" / "results" / "surfaces.json"
PARTS = ("depth", "real", "stereo", "cloud", "texture", "memory", "survey")
COMPARED = ("patch match", "peers", "survey peers")
"""Parts that measure other methods and programs, which run only on request."""
THREADS = 2
IN_SAMPLE = ("courtyard",)
"""Scenes that were used while the code was written."""


def parts_of(arguments: argparse.Namespace) -> dict[str, Callable[[Path, Path], dict[str, dict[str, Any]]]]:
    """Each part by name: (work folder, data folder) to rows of figures."""
    return {
        "depth": depth_part,
        "real": real_part,
        "stereo": stereo_part,
        "cloud": cloud_part,
        "texture": texture_part,
        "memory": lambda work, _: memory_part(work, arguments.views),
        "survey": survey_part,
        "patch match": patch_match_part,
        "peers": partial(peers_part, python=arguments.open3d_python),
        "survey peers": partial(survey_peers_part, python=arguments.orthomosaic_python),
    }


def show(part: str, rows: dict[str, dict[str, Any]]) -> None:
    """Print the figures of a part, one column for each row."""
    table = Table("", *rows, title=part)
    for key in dict.fromkeys(key for row in rows.values() for key in row):
        cells = [row.get(key, "") for row in rows.values()]
        table.add_row(key, *(f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in cells))
    Console(width=200).print(table)


def main() -> None:
    """Run the parts, and store and print their figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", nargs="+", choices=PARTS + COMPARED, default=list(PARTS))
    parser.add_argument(
        "--fit", action="store_true", help="refit SHARED of dense/depth.py on the courtyard instead"
    )
    parser.add_argument("--views", type=int, default=24, help="number of images of the memory part")
    parser.add_argument("--open3d-python", default=sys.executable, help="Python interpreter that has Open3D")
    parser.add_argument(
        "--orthomosaic-python", default=sys.executable, help="Python interpreter that has pyOrthomosaic"
    )
    parser.add_argument("--work", type=Path, default=REPOSITORY / "build" / "surfaces")
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    arguments = parser.parse_args()
    _parallel.set_num_threads(THREADS)
    if arguments.fit:
        show("fit", {"courtyard": fit_shared(arguments.work)})
        return
    parts = parts_of(arguments)
    for part in arguments.part:
        rows = parts[part](arguments.work, data_root(arguments.data))
        known = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.is_file() else {"parts": {}}
        known["in_sample"] = list(IN_SAMPLE)
        known["parts"][part] = {"machine": describe_machine(THREADS), "rows": rows}
        RESULTS.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
        show(part, rows)


if __name__ == "__main__":
    main()
