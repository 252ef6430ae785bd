"""Relative poses of many pairs of wide-angle cameras; a separate module, so that others need not compile it."""

import math

import numpy as np

from epipole._jit import kernel
from epipole.cameras._camera_kernels import NUM_PARAMS, project_with_jacobian_one, unproject_one
from epipole.robust.pairs._pair_kernels import choose, longest, mean_focal, search_pair, shuffle
from epipole.robust.pairs._wide_motion_kernels import WideMotionProblem


@kernel(fuse=True)
def _ray(pairs, p, k, which, scale, by_point, by_params, out, column):
    """The ray of match k in camera `which`, and its slope times `scale`; returns whether it exists."""
    camera = pairs.camera1[p] if which == 0 else pairs.camera2[p]
    model, params = np.int64(pairs.models[camera]), pairs.params[camera]
    x, y, z = unproject_one(model, params, pairs.pixels[2 * which, k], pairs.pixels[2 * which + 1, k])
    u, v = project_with_jacobian_one(model, params, x, y, z, by_point, by_params)
    out[3 * which, column], out[3 * which + 1, column], out[3 * which + 2, column] = x, y, z
    aa = bb = ab = 0.0
    for i in range(3):
        aa += by_point[0, i] * by_point[0, i]
        bb += by_point[1, i] * by_point[1, i]
        ab += by_point[0, i] * by_point[1, i]
    over = scale / (aa * bb - ab * ab)
    for i in range(3):  # P^T (P P^T)^-1
        row = 6 + 6 * which + 2 * i
        out[row, column] = over * (bb * by_point[0, i] - ab * by_point[1, i])
        out[row + 1, column] = over * (aa * by_point[1, i] - ab * by_point[0, i])
    return abs(over) < math.inf and abs(u + v) < math.inf


@kernel(allocates=True)
def fit_wide_motions(pairs, wanted, use, quality, search, fits):
    """Relative poses of the wanted pairs on the matches marked in `use`."""
    most = longest(pairs)
    chosen, items = np.empty(most, np.int64), np.empty((18, most))
    by_point, by_params = np.empty((2, 3)), np.empty((2, NUM_PARAMS))
    for p in range(len(pairs.seed)):
        if not wanted[p]:
            continue
        count = choose(pairs, p, use, chosen)
        shuffle(chosen, count, pairs.seed[p])
        scale = mean_focal(pairs, p)
        fits.frame[p, 4] = scale
        seen = 0
        for c in range(count):
            k = chosen[c]
            if _ray(pairs, p, k, 0, scale, by_point, by_params, items, seen) and _ray(
                pairs, p, k, 1, scale, by_point, by_params, items, seen
            ):
                chosen[seen] = k
                seen += 1
        problem = WideMotionProblem(items[:, :seen].copy())
        search_pair(pairs, p, problem, chosen, quality, search, fits)
