"""Views of a small courtyard with exact depth, shared by the tests of dense reconstruction."""

from functools import cache

import numpy as np

from epipole.cameras import Camera
from epipole.dense.view import DenseView
from epipole.synthetic import courtyard, courtyard_views
from epipole.synthetic.render import render

CAMERA = Camera("PINHOLE", 320, 240, [290.0, 290.0, 159.5, 119.5])
RANGE = (1.8, 9.0)


@cache
def rendered(num_views=24):
    """Views, and the exact depth of each."""
    poses = courtyard_views(num_views)
    images = [render(courtyard(), CAMERA, poses[k], noise_sigma=1.0, seed=k) for k in range(num_views)]
    views = [DenseView(f"{k:03d}.jpg", image.rgb, CAMERA, poses[k]) for k, image in enumerate(images)]
    return views, [image.depth for image in images]


def times_seen(k, sources):
    """(h, w) number of sources that see the surface at each pixel of view k, by exact depth."""
    views, depths = rendered()
    depth = depths[k]
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - 159.5) / 290.0, (v - 119.5) / 290.0, np.ones(u.shape)], axis=-1)
    known = np.isfinite(depth)
    points = views[k].cam_from_world.inverse().apply((rays * depth[..., None])[known])
    out = np.zeros(depth.shape, int)
    for source in sources:
        in_cam = views[source].cam_from_world.apply(points)
        pixels = np.rint(CAMERA.project(in_cam))
        inside = (pixels >= 0).all(axis=1) & (pixels < [CAMERA.width, CAMERA.height]).all(axis=1)
        column, row = pixels[inside].astype(int).T
        near = np.abs(depths[source][row, column] - in_cam[inside, 2]) < 0.02 * in_cam[inside, 2]
        seen = np.zeros(len(points), int)
        seen[np.flatnonzero(inside)[near]] = 1
        out[known] += seen
    return out
