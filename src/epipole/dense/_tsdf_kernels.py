"""TSDF fusion of depth images (Curless and Levoy, SIGGRAPH 1996)."""

import numpy as np

from epipole._jit import kernel

LEAST_COVERAGE = np.float32(0.5)
"""Coverage above which a pixel shows a surface; with less, the ray passes through the volume."""


@kernel
def fuse(view, depth, coverage, rgb, low, size, band, start, stop, distance, weight, color):
    """Integrate an image into planes start..stop of constant x.

    view: rotation (9), translation (3), focal lengths (2), principal point (2). depth (h, w) along the optical axis, times
    coverage (h, w); rgb (h, w, 3) times coverage. distance (x, y, z) receives means of depth minus that of the voxel, in units of
    `band` and at most 1; weight (x, y, z) their number; color (x, y, z, 3) means within the band. Voxels farther behind the
    surface than the band are not changed.
    """
    height, width = depth.shape
    r, t = view[:9], view[9:12]
    fx, fy, cx, cy = view[12], view[13], view[14], view[15]
    _, across, down = distance.shape
    one = np.float32(1.0)
    for i in range(start, stop):
        px = low[0] + size * (i + 0.5)
        for j in range(across):
            py = low[1] + size * (j + 0.5)
            for k in range(down):
                pz = low[2] + size * (k + 0.5)
                z = r[6] * px + r[7] * py + r[8] * pz + t[2]
                if z <= size:
                    continue
                u = fx * (r[0] * px + r[1] * py + r[2] * pz + t[0]) / z + cx + 0.5
                v = fy * (r[3] * px + r[4] * py + r[5] * pz + t[1]) / z + cy + 0.5
                if u < 0.0 or v < 0.0 or u >= width or v >= height:
                    continue
                row, column = int(v), int(u)
                seen, ahead = coverage[row, column], one
                if seen >= LEAST_COVERAGE:
                    ahead = np.float32((depth[row, column] / seen - z) / band)
                    if ahead < -one:
                        continue
                    ahead = min(ahead, one)
                total = weight[i, j, k]
                fraction = one / (total + one)
                distance[i, j, k] += fraction * (ahead - distance[i, j, k])
                weight[i, j, k] = total + one
                if seen >= LEAST_COVERAGE and ahead < one:
                    for c in range(3):
                        value = rgb[row, column, c] / seen
                        color[i, j, k, c] += fraction * (value - color[i, j, k, c])
