"""Ray casting: the nearest surface along every ray of an image, its color and distance."""

import math

import numpy as np

from epipole._jit import kernel
from epipole.cameras._camera_kernels import unproject_one
from epipole.synthetic._surface_kernels import (
    add_cells,
    add_color,
    fill_noise,
    hit_box,
    hit_height_field,
    hit_plane,
    hit_sphere,
)

PLANE, BOX, SPHERE, HEIGHT_FIELD = 0, 1, 2, 3
RICH, PLAIN, TILED = 0, 1, 2


@kernel
def _trace(kinds, params, seeds, ox, oy, oz, dx, dy, dz, normal, trial):
    """Nearest primitive along a ray and its distance; -1 for the sky."""
    best, hit = math.inf, -1
    for n in range(len(kinds)):
        if _misses(params[n], dx, dy, dz):
            continue
        if kinds[n] == PLANE:
            t = hit_plane(params[n], ox, oy, oz, dx, dy, dz, trial)
        elif kinds[n] == BOX:
            t = hit_box(params[n], ox, oy, oz, dx, dy, dz, trial)
        elif kinds[n] == SPHERE:
            t = hit_sphere(params[n], ox, oy, oz, dx, dy, dz, trial)
        else:
            continue
        if t < best:
            best, hit = t, n
            for c in range(3):
                normal[c] = trial[c]
    for n in range(len(kinds)):  # last: the march ends at the nearest hit in front of the ground
        if kinds[n] == HEIGHT_FIELD and not _misses(params[n], dx, dy, dz):
            t = hit_height_field(params[n], ox, oy, oz, dx, dy, dz, seeds[n], best, trial)
            if t < best:
                best, hit = t, n
                for c in range(3):
                    normal[c] = trial[c]
    return hit, best


@kernel(allocates=True)
def _prepared(kinds, params, o):
    """Parameters with precomputed values common to all rays from o.

    Columns 11 to 14: center - o, and |center - o|^2 - R^2 for the bounding sphere of radius R. Columns 7 and 8: cosine and sine of a
    box's angle. Column 7: steepest slope of a height field.
    """
    out = np.zeros((len(kinds), 15))
    out[:, : params.shape[1]] = params
    for n in range(len(kinds)):
        p, radius_sq = params[n], 0.0
        if kinds[n] == PLANE:
            radius_sq = p[9] ** 2 + p[10] ** 2
        elif kinds[n] == BOX:
            out[n, 7], out[n, 8] = math.cos(p[6]), math.sin(p[6])
            radius_sq = p[3] ** 2 + p[4] ** 2 + p[5] ** 2
        elif kinds[n] == SPHERE:
            radius_sq = p[3] ** 2
        else:
            # |d noise| <= 2 * 1.5 per cell along each axis, for the two octaves of `height_at`.
            out[n, 7] = math.sqrt(2.0) * 3.0 * (1.0 + 0.35 * 2.7) * abs(p[5]) / p[6]
            radius_sq = p[3] ** 2 + p[4] ** 2 + (1.4 * p[5]) ** 2
        for c in range(3):
            out[n, 11 + c] = p[c] - o[c]
            out[n, 14] += out[n, 11 + c] ** 2
        out[n, 14] -= 1.0001 * radius_sq
    return out


@kernel
def _misses(p, dx, dy, dz):
    """Whether a ray (unit direction) from outside misses the bounding sphere of a primitive."""
    along = p[11] * dx + p[12] * dy + p[13] * dz
    return p[14] > 0.0 and (along < 0.0 or along * along < p[14])


@kernel
def _rotated(motion, x, y, z, d):
    """Rotate a direction from camera to world coordinates, into d."""
    for c in range(3):
        d[c] = motion[c] * x + motion[3 + c] * y + motion[6 + c] * z


@kernel
def _render_row(model, camera_params, motion, prepared, v, row):
    """Trace the pixels (-1, v) to (w, v) into row: rays (camera coordinates), hits, surfaces.

    A surface is the point (0:3), the normal (3:6) and the distance (6).
    """
    rays, hits, surfaces = row
    kinds, params, seeds, o, d, normal, trial = prepared
    for u in range(len(rays)):
        rays[u, 0], rays[u, 1], rays[u, 2] = unproject_one(model, camera_params, u - 1.0, v)
        hits[u] = -1
        if rays[u, 2] == rays[u, 2]:
            _rotated(motion, rays[u, 0], rays[u, 1], rays[u, 2], d)
            hits[u], t = _trace(kinds, params, seeds, o[0], o[1], o[2], d[0], d[1], d[2], normal, trial)
            for c in range(3):
                surfaces[u, c], surfaces[u, 3 + c] = o[c] + t * d[c], normal[c]
            surfaces[u, 6] = t


@kernel
def _is_inside(above, here, below, u):
    """Whether pixel u - 1 and its four neighbors hit the same primitive on the same side."""
    hit, normal = here[1][u], here[2][u, 3:6]
    for hits, surfaces, n in (
        (above[1], above[2], u),
        (below[1], below[2], u),
        (here[1], here[2], u - 1),
        (here[1], here[2], u + 1),
    ):
        if hits[n] != hit:
            return False
        if normal[0] * surfaces[n, 3] + normal[1] * surfaces[n, 4] + normal[2] * surfaces[n, 5] < 0.9:
            return False
    return hit >= 0


@kernel
def _on_tangent_plane(surface, o, d):
    """Distance along the ray (o, d) to the tangent plane of a surface; infinite for a parallel ray."""
    facing, along = 0.0, 0.0
    for c in range(3):
        facing += surface[3 + c] * d[c]
        along += surface[3 + c] * (surface[c] - o[c])
    return along / facing if abs(facing) > 1e-3 and along / facing > 0.0 else math.inf


@kernel
def _ray_beside(model, camera_params, motion, above, here, below, u, v, du, dv, d):
    """World direction d of the ray of (u + du, v + dv), interpolated from neighboring rays; False if there is none.

    Interpolation is exact to second order. Where a neighbor has no ray, at the border of the field of view, the pixel is unprojected.
    """
    x = here[u + 1, 0] + 0.5 * (du * (here[u + 2, 0] - here[u, 0]) + dv * (below[u + 1, 0] - above[u + 1, 0]))
    y = here[u + 1, 1] + 0.5 * (du * (here[u + 2, 1] - here[u, 1]) + dv * (below[u + 1, 1] - above[u + 1, 1]))
    z = here[u + 1, 2] + 0.5 * (du * (here[u + 2, 2] - here[u, 2]) + dv * (below[u + 1, 2] - above[u + 1, 2]))
    size = math.sqrt(x * x + y * y + z * z)
    if size == size:
        x, y, z = x / size, y / size, z / size
    else:
        x, y, z = unproject_one(model, camera_params, u + du, v + dv)
    _rotated(motion, x, y, z, d)
    return d[0] == d[0]


@kernel
def _light_on(light, normal, d):
    """Brightness of a surface, and the cosine between its normal and the viewing direction d."""
    facing = normal[0] * d[0] + normal[1] * d[1] + normal[2] * d[2]
    side = -1.0 if facing > 0.0 else 1.0
    shine = side * (normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2])
    return 0.62 + 0.38 * max(0.0, shine), abs(facing)


@kernel
def _texture_position(kind, texture, p, tile, x, y, z, position):
    """Coordinates of a surface point in the solid texture: in the world, or for TILED in the surface's own axes."""
    position[0], position[1], position[2] = x, y, z
    if texture != TILED or not tile > 0.0:
        return
    x, y, z = x - p[0], y - p[1], z - p[2]
    if kind == PLANE:
        position[0] = x * p[3] + y * p[4] + z * p[5] + p[9]
        position[1] = x * p[6] + y * p[7] + z * p[8] + p[10]
        position[2] = 0.0
    elif kind == BOX:
        position[0] = p[7] * x + p[8] * y + p[3]
        position[1] = -p[8] * x + p[7] * y + p[4]
        position[2] = z + p[5]
    else:
        position[0], position[1], position[2] = x, y, z
    for c in range(3):
        position[c] += 0.137 * tile  # keeps a face at zero off the seam
        position[c] -= tile * math.floor(position[c] / tile)


@kernel(allocates=True)
def _row(width):
    return np.empty((width + 2, 3)), np.empty(width + 2, np.int64), np.empty((width + 2, 7))


@kernel(allocates=True)
def render_rows(scene, model, camera_params, motion, start, stop, width, rgb, depth):
    """Rows start..stop of an image: rgb (h, w, 3) in [0, 1] with four samples per pixel, and the depth at the pixel center.

    Colors are added to rgb, so that several exposures accumulate.

    Smooth texture is computed once per pixel, at its center: it has no detail finer than two footprints. Edges of cells and of objects
    are sampled four times; inside an object the samples lie on the tangent plane at the center (exact up to terms of second order in a
    quarter pixel).
    """
    kinds, given, textures, colors, seeds, light = scene
    normal, trial, d, o = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    smooth, texture, position = np.empty(3), np.empty(3), np.empty(3)
    for c in range(3):
        o[c] = -(motion[c] * motion[9] + motion[3 + c] * motion[10] + motion[6 + c] * motion[11])
    params = _prepared(kinds, given, o)
    prepared = kinds, params, seeds, o, d, normal, trial
    spacing = 1.0 / camera_params[0]
    above, here, below = _row(width), _row(width), _row(width)
    _render_row(model, camera_params, motion, prepared, start - 1.0, here)
    _render_row(model, camera_params, motion, prepared, start + 0.0, below)
    for v in range(start, stop):
        above, here, below = here, below, above
        _render_row(model, camera_params, motion, prepared, v + 1.0, below)
        for u in range(width):
            own, surface = here[1][u + 1], here[2][u + 1]
            inside = _is_inside(above, here, below, u + 1)
            if own >= 0:
                depth[v, u] = surface[6] * here[0][u + 1, 2]
                _rotated(motion, here[0][u + 1, 0], here[0][u + 1, 1], here[0][u + 1, 2], d)
                _, facing = _light_on(light, surface[3:6], d)
                if textures[own] != PLAIN:
                    covered = 0.6 * surface[6] * spacing / math.sqrt(max(facing, 0.05))
                    x, y, w = surface[0], surface[1], surface[2]
                    _texture_position(
                        kinds[own], textures[own], params[own], given[own, 11], x, y, w, position
                    )
                    fill_noise(seeds[own], position[0], position[1], position[2], covered, smooth)
            for sample in range(4):
                du, dv = (0.25 if sample % 2 else -0.25), (0.25 if sample // 2 else -0.25)
                if not _ray_beside(
                    model, camera_params, motion, above[0], here[0], below[0], u, v, du, dv, d
                ):
                    continue
                hit, t = own, math.inf
                if inside:
                    t = _on_tangent_plane(surface, o, d)
                    normal[:] = surface[3:6]
                if not t < math.inf:
                    hit, t = _trace(kinds, params, seeds, o[0], o[1], o[2], d[0], d[1], d[2], normal, trial)
                if hit < 0:
                    rgb[v, u, 0] += 0.25 * 0.62
                    rgb[v, u, 1] += 0.25 * 0.74
                    rgb[v, u, 2] += 0.25 * 0.88
                    continue
                brightness, facing = _light_on(light, normal, d)
                texture[:] = 0.0
                if textures[hit] != PLAIN:
                    x, y, w = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
                    _texture_position(
                        kinds[hit], textures[hit], params[hit], given[hit, 11], x, y, w, position
                    )
                    covered = 0.6 * t * spacing / math.sqrt(max(facing, 0.05))
                    if hit == own:
                        texture[:] = smooth
                    else:
                        fill_noise(seeds[hit], position[0], position[1], position[2], covered, texture)
                    add_cells(seeds[hit], position[0], position[1], position[2], covered, texture)
                add_color(colors[hit], texture, brightness, 0.25, rgb[v, u])
