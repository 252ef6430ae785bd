"""Use epipole's output in pycolmap: `python -m benchmarks.peers.pycolmap_reads OUT RESULT.json`.

pycolmap reads the model, adjusts it with epipole's final loss, and maps from the database. If the intrinsics were unknown, the
adjustment runs twice: with fixed and with free intrinsics (a different problem, because epipole has a prior on them).
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

FINAL_LOSS_SCALE_PX = 0.5
"""Scale of the Cauchy loss in epipole's last adjustment."""


def examine(out: Path) -> dict[str, Any]:
    """Read OUT/sparse/0, adjust it, and map from a copy of OUT/database.db."""
    import pycolmap

    settings = json.loads((out / "summary.json").read_text())
    is_known = all(source == "given" for source in settings["focal_sources"])

    def model() -> Any:
        return pycolmap.Reconstruction(str(out / "sparse" / "0"))

    read = {
        "images": model().num_reg_images(),
        "points": model().num_points3D(),
        "observations": model().compute_num_observations(),
    }
    return {
        "intrinsics_held": is_known,
        "read": read,
        "adjusted": _adjust(pycolmap, model(), refine_intrinsics=False),
        "adjusted_with_lenses": None if is_known else _adjust(pycolmap, model(), refine_intrinsics=True),
        "mapped": _map(pycolmap, out, is_known),
    }


def _adjust(pycolmap: Any, model: Any, *, refine_intrinsics: bool) -> dict[str, Any]:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = refine_intrinsics
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = FINAL_LOSS_SCALE_PX
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_bundle_adjuster(options, config, model).solve().ceres_summary
    gain = 1.0 - summary.final_cost / summary.initial_cost
    return {"cost": summary.initial_cost, "cost_after": summary.final_cost, "gain": gain}


def _map(pycolmap: Any, out: Path, is_known: bool) -> dict[str, Any]:
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = options.ba_refine_extra_params = not is_known
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        shutil.copyfile(out / "database.db", database)
        models = pycolmap.incremental_mapping(str(database), str(out / "images"), folder, options)
    sizes = sorted((m.num_reg_images() for m in models.values()), reverse=True)
    largest = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
    return {"models": sizes, "points": largest.num_points3D() if largest is not None else 0}


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(json.dumps(examine(Path(sys.argv[1]).resolve()), indent=2), encoding="utf-8")
