"""Units of SfM that others have made, with a digest that fits: what they hold is checked where it is read."""

import numpy as np
import pytest
from sfm_units import features, geometries, matches, put, use_graph, use_putative

from epipole.errors import WorkspaceError
from epipole.pipelines.sfm.matching.feature_stage import load_features

USES = {
    "features": (features, load_features),
    "matches": (matches, use_putative),
    "geometries": (geometries, use_graph),
}


@pytest.mark.parametrize("what", list(USES))
def test_what_is_whole_is_read(what, tmp_path):
    make, use = USES[what]
    assert use(put(tmp_path / "a.npz", make())) is not None


def at(name, where, value):
    def change(arrays):
        arrays[name] = arrays[name].copy()
        arrays[name][where] = value

    return change


@pytest.mark.parametrize(
    ("what", "change"),
    [
        ("features", lambda arrays: arrays.pop("scale_px")),
        ("features", lambda arrays: arrays.update(pixels=arrays["pixels"][:3])),
        ("features", lambda arrays: arrays.update(descriptors=arrays["descriptors"].astype(np.float32))),
        ("features", at("pixels", (0, 0), np.nan)),
        ("matches", at("matches", (0, 0), 6)),
        ("matches", at("matches", (0, 1), -1)),
        ("matches", at("matches", (3, 1), 4)),
        ("matches", at("offsets", 1, 10**9)),
        ("matches", lambda arrays: arrays.update(offsets=arrays["offsets"][:2])),
        ("geometries", at("matches", (2, 0), 5)),
        ("geometries", at("kind", 0, 77)),
        ("geometries", at("rotation", (0, 0, 0), 3.0)),
        ("geometries", lambda arrays: arrays.pop("homography")),
        ("geometries", lambda arrays: arrays.update(kind=arrays["kind"][:1])),
    ],
)
def test_arrays_that_do_not_fit_are_refused(what, change, tmp_path):
    make, use = USES[what]
    path = put(tmp_path / "a.npz", make(), change)
    with pytest.raises(WorkspaceError, match="delete it and run the command again"):
        use(path)
