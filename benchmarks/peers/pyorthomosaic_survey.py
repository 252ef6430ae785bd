"""PyOrthomosaic's height model and orthophoto, in its own process: `python pyorthomosaic_survey.py IMAGES GCP_LIST OUT GCP_SIGMA_M`."""

import json
import sys
import time
from pathlib import Path

from orthomosaic import Options3D, build_3d


def main() -> None:
    """Run it with its defaults, without the mesh and the ground below the houses, and write the seconds."""
    images, control, out, sigma = sys.argv[1:]
    options = Options3D(
        gcp=control, gcp_sigma=float(sigma), backend="cpu", dtm=False, mesh_method="dsm", formats=("laz",)
    )
    wall, processor = time.perf_counter(), time.process_time()
    build_3d(images, out, options)
    seconds = {
        "all, s": time.perf_counter() - wall,
        "all, processor s": time.process_time() - processor,
    }
    (Path(out) / "seconds.json").write_text(json.dumps(seconds), encoding="utf-8")


if __name__ == "__main__":
    main()
