"""Ray casting and solid textures.

The texture is a sum of octaves of value noise on hashed lattices (Perlin 1985 for the idea, a 64-bit mix for the
hash) and of hashed cells with hard edges. An octave fades out when its wavelength falls below two footprints of
a pixel, as a lens and a sensor would blur it: without this, details would jump from view to view.
"""

import math

import numpy as np

from epipole._jit import kernel
from epipole.cameras._camera_kernels import unproject_one

PLANE, BOX, SPHERE, HEIGHT_FIELD = 0, 1, 2, 3
RICH, PLAIN = 0, 1
NUM_OCTAVES, NUM_CELLS = 9, 4
MARCH_STEPS = 24


@kernel
def _hash(x, y, z, seed):
    h = np.uint64(x) * np.uint64(0x9E3779B97F4A7C15)
    h ^= np.uint64(y) * np.uint64(0xC2B2AE3D27D4EB4F)
    h ^= np.uint64(z) * np.uint64(0x165667B19E3779F9)
    h ^= np.uint64(seed) * np.uint64(0xD6E8FEB86659FD93)
    h = (h ^ (h >> np.uint64(32))) * np.uint64(0xD6E8FEB86659FD93)
    h = (h ^ (h >> np.uint64(32))) * np.uint64(0xD6E8FEB86659FD93)
    return h ^ (h >> np.uint64(32))


@kernel
def _add_noise(x, y, z, seed, weight, rgb):
    """Three channels of value noise in [-1, 1] at (x, y, z), times weight, added to rgb."""
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = x - i, y - j, z - k
    u, v, w = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v), w * w * (3.0 - 2.0 * w)
    for a in range(2):
        for b in range(2):
            for c in range(2):
                share = weight * (u if a else 1.0 - u) * (v if b else 1.0 - v) * (w if c else 1.0 - w)
                h = _hash(np.int64(i) + a, np.int64(j) + b, np.int64(k) + c, seed)
                for channel in range(3):
                    value = float((h >> np.uint64(16 * channel)) & np.uint64(0xFFFF)) / 32767.5 - 1.0
                    rgb[channel] += share * value


@kernel
def _corner(i, j, seed):
    return float(_hash(i, j, np.int64(0), seed) >> np.uint64(40)) / 8388607.5 - 1.0


@kernel
def _noise_2d(x, y, seed):
    """Value noise in [-1, 1] on the plane."""
    i, j = np.int64(math.floor(x)), np.int64(math.floor(y))
    u, v = x - i, y - j
    u, v = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v)
    low = _corner(i, j, seed) * (1.0 - u) + _corner(i + 1, j, seed) * u
    high = _corner(i, j + 1, seed) * (1.0 - u) + _corner(i + 1, j + 1, seed) * u
    return low * (1.0 - v) + high * v


@kernel
def height_at(x, y, amplitude, wavelength, seed):
    """Height of a rolling ground: two octaves of noise."""
    broad = _noise_2d(x / wavelength, y / wavelength, seed)
    return amplitude * (broad + 0.35 * _noise_2d(2.7 * x / wavelength, 2.7 * y / wavelength, seed + 1))


@kernel
def _noise(seed, x, y, z, footprint, out):
    """The smooth part of the rich texture, for a pixel that covers `footprint` metres of it."""
    out[:] = 0.0
    wavelength, weight = 1.3, 0.30
    for octave in range(NUM_OCTAVES):
        fade = min(1.0, max(0.0, 0.5 * wavelength / footprint - 1.0))
        if fade <= 0.0:
            break
        _add_noise(x / wavelength, y / wavelength, z / wavelength, seed + octave, weight * fade, out)
        wavelength *= 0.52
        weight *= 0.86


@kernel
def _add_cells(seed, x, y, z, footprint, out):
    """The part with hard edges: a quarter of hashed cells, in four sizes."""
    # Cells stand askew, so that none lies along a wall.
    p = 0.80 * x + 0.53 * y + 0.28 * z
    q = -0.56 * x + 0.83 * y + 0.04 * z
    r = -0.21 * x - 0.19 * y + 0.96 * z
    size = 0.23
    for n in range(NUM_CELLS):
        fade = min(1.0, max(0.0, 0.25 * size / footprint - 1.0))
        if fade <= 0.0:
            break
        h = _hash(
            np.int64(math.floor(p / size)),
            np.int64(math.floor(q / size)),
            np.int64(math.floor(r / size)),
            seed + 50 + n,
        )
        if (h & np.uint64(3)) == np.uint64(0):
            for c in range(3):
                value = float((h >> np.uint64(8 + 16 * c)) & np.uint64(0xFFFF)) / 32767.5 - 1.0
                out[c] += 0.28 * fade * value
        size *= 0.43


@kernel
def _add_color(color, texture, light, weight, rgb):
    """Rgb += weight * the lit colour of a surface whose texture adds `texture` to its own colour."""
    mean = (texture[0] + texture[1] + texture[2]) / 3.0
    for c in range(3):
        rgb[c] += weight * min(1.0, max(0.0, (color[c] + 0.8 * mean + 0.2 * texture[c]) * light))


@kernel
def _hit_plane(p, ox, oy, oz, dx, dy, dz, normal):
    nx, ny, nz = p[4] * p[8] - p[5] * p[7], p[5] * p[6] - p[3] * p[8], p[3] * p[7] - p[4] * p[6]
    facing = nx * dx + ny * dy + nz * dz
    if abs(facing) < 1e-12:
        return math.inf
    t = (nx * (p[0] - ox) + ny * (p[1] - oy) + nz * (p[2] - oz)) / facing
    if t <= 1e-6:
        return math.inf
    x, y, z = ox + t * dx - p[0], oy + t * dy - p[1], oz + t * dz - p[2]
    if abs(x * p[3] + y * p[4] + z * p[5]) > p[9] or abs(x * p[6] + y * p[7] + z * p[8]) > p[10]:
        return math.inf
    normal[0], normal[1], normal[2] = nx, ny, nz
    return t


@kernel
def _hit_box(p, ox, oy, oz, dx, dy, dz, normal):
    """Slabs (Kay and Kajiya 1986) in the box's own axes: turned about z by an angle of cosine p[7], sine p[8]."""
    cos, sin = p[7], p[8]
    rx, ry = ox - p[0], oy - p[1]
    lx, ly, lz = cos * rx + sin * ry, -sin * rx + cos * ry, oz - p[2]
    ux, uy, uz = cos * dx + sin * dy, -sin * dx + cos * dy, dz
    near, far, axis, side = -math.inf, math.inf, 0, 1.0
    for c in range(3):
        o = lx if c == 0 else (ly if c == 1 else lz)
        d = ux if c == 0 else (uy if c == 1 else uz)
        if abs(d) < 1e-12:
            if abs(o) > p[3 + c]:
                return math.inf
            continue
        a, b = (-p[3 + c] - o) / d, (p[3 + c] - o) / d
        if min(a, b) > near:
            near, axis, side = min(a, b), c, (-1.0 if d > 0.0 else 1.0)
        far = min(far, max(a, b))
    if near > far or near <= 1e-6:
        return math.inf
    nx, ny = (side if axis == 0 else 0.0), (side if axis == 1 else 0.0)
    normal[0], normal[1], normal[2] = cos * nx - sin * ny, sin * nx + cos * ny, side if axis == 2 else 0.0
    return near


@kernel
def _hit_sphere(p, ox, oy, oz, dx, dy, dz, normal):
    rx, ry, rz = ox - p[0], oy - p[1], oz - p[2]
    b = rx * dx + ry * dy + rz * dz
    root = b * b - (rx * rx + ry * ry + rz * rz - p[3] * p[3])
    if root < 0.0:
        return math.inf
    t = -b - math.sqrt(root)
    if t <= 1e-6:
        return math.inf
    normal[0], normal[1], normal[2] = (rx + t * dx) / p[3], (ry + t * dy) / p[3], (rz + t * dz) / p[3]
    return t


@kernel
def _hit_height_field(p, ox, oy, oz, dx, dy, dz, seed, nearest, normal):
    """March down to the first point below the ground, no farther than `nearest`, then halve by the secant rule.

    The ground is never steeper than p[7], so that a step of gap / (fall + steepness * way) cannot cross it; steps
    that short in the end are lengthened a little, for the secant needs a point below.
    """
    if dz >= -1e-9:
        return math.inf
    top, bottom = p[2] + 1.4 * p[5], p[2] - 1.4 * p[5]
    first, last = max((top - oz) / dz, 1e-6), min((bottom - oz) / dz, nearest)
    if last <= first:
        return math.inf
    closing, least = -dz + p[7] * math.sqrt(dx * dx + dy * dy), (last - first) / MARCH_STEPS / 8.0
    low, above = first, oz + first * dz - p[2] - height_at(ox + first * dx, oy + first * dy, p[5], p[6], seed)
    while low < last:
        high = min(low + max(above / closing, least), last)
        below = oz + high * dz - p[2] - height_at(ox + high * dx, oy + high * dy, p[5], p[6], seed)
        if below > 0.0:
            if high == last:
                break
            low, above = high, below
            continue
        t = high
        for k in range(30):
            # Alternate the secant's point with the middle: sure and fast.
            share = above / (above - below) if k % 3 and above > below else 0.5
            t = low + share * (high - low)
            gap = oz + t * dz - p[2] - height_at(ox + t * dx, oy + t * dy, p[5], p[6], seed)
            if abs(gap) < 1e-12:
                break
            if gap > 0.0:
                low, above = t, gap
            else:
                high, below = t, gap
        x, y = ox + t * dx, oy + t * dy
        if abs(x - p[0]) > p[3] or abs(y - p[1]) > p[4]:
            return math.inf
        e = 1e-3
        here = height_at(x, y, p[5], p[6], seed)
        sx = (height_at(x + e, y, p[5], p[6], seed) - here) / e
        sy = (height_at(x, y + e, p[5], p[6], seed) - here) / e
        size = math.sqrt(sx * sx + sy * sy + 1.0)
        normal[0], normal[1], normal[2] = -sx / size, -sy / size, 1.0 / size
        return t
    return math.inf


@kernel
def _trace(kinds, params, seeds, ox, oy, oz, dx, dy, dz, normal, trial):
    """Nearest primitive along a ray and its distance; -1 for the sky."""
    best, hit = math.inf, -1
    for n in range(len(kinds)):
        if _misses(params[n], dx, dy, dz):
            continue
        if kinds[n] == PLANE:
            t = _hit_plane(params[n], ox, oy, oz, dx, dy, dz, trial)
        elif kinds[n] == BOX:
            t = _hit_box(params[n], ox, oy, oz, dx, dy, dz, trial)
        elif kinds[n] == SPHERE:
            t = _hit_sphere(params[n], ox, oy, oz, dx, dy, dz, trial)
        else:
            continue
        if t < best:
            best, hit = t, n
            for c in range(3):
                normal[c] = trial[c]
    for n in range(len(kinds)):  # last: the march ends at what stands before the ground
        if kinds[n] == HEIGHT_FIELD and not _misses(params[n], dx, dy, dz):
            t = _hit_height_field(params[n], ox, oy, oz, dx, dy, dz, seeds[n], best, trial)
            if t < best:
                best, hit = t, n
                for c in range(3):
                    normal[c] = trial[c]
    return hit, best


@kernel(allocates=True)
def _prepared(kinds, params, o):
    """Parameters with what every ray from o would compute again.

    From column 11: the centre from o, and |centre - o|^2 - R^2 for the ball of radius R that holds the primitive;
    a box's cosine and sine in 7 and 8, the steepest slope of a ground in 7.
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
    """Whether a ray (unit direction) from outside passes by the ball around a primitive."""
    along = p[11] * dx + p[12] * dy + p[13] * dz
    return p[14] > 0.0 and (along < 0.0 or along * along < p[14])


@kernel
def _turned(motion, x, y, z, d):
    """World direction d of a direction in camera coordinates."""
    for c in range(3):
        d[c] = motion[c] * x + motion[3 + c] * y + motion[6 + c] * z


@kernel
def _look_along_row(model, camera_params, motion, prepared, v, row):
    """Rays of the pixels (-1, v) to (w, v) and what they meet; row: rays (camera coordinates), hits, surfaces.

    A surface is the point (0:3), the normal (3:6) and the distance (6).
    """
    rays, hits, surfaces = row
    kinds, params, seeds, o, d, normal, trial = prepared
    for u in range(len(rays)):
        rays[u, 0], rays[u, 1], rays[u, 2] = unproject_one(model, camera_params, u - 1.0, v)
        hits[u] = -1
        if rays[u, 2] == rays[u, 2]:
            _turned(motion, rays[u, 0], rays[u, 1], rays[u, 2], d)
            hits[u], t = _trace(kinds, params, seeds, o[0], o[1], o[2], d[0], d[1], d[2], normal, trial)
            for c in range(3):
                surfaces[u, c], surfaces[u, 3 + c] = o[c] + t * d[c], normal[c]
            surfaces[u, 6] = t


@kernel
def _is_inside(above, here, below, u):
    """Whether pixel u - 1 and its four neighbours meet one primitive, on one side of it."""
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
    """Distance along the ray (o, d) to the tangent plane of a surface; infinite where it runs along it."""
    facing, way = 0.0, 0.0
    for c in range(3):
        facing += surface[3 + c] * d[c]
        way += surface[3 + c] * (surface[c] - o[c])
    return way / facing if abs(facing) > 1e-3 and way / facing > 0.0 else math.inf


@kernel
def _ray_beside(model, camera_params, motion, above, here, below, u, v, du, dv, d):
    """World direction d of the ray of (u + du, v + dv), from the rays of the rows around; False where there is none.

    Interpolation is exact to second order; at the rim of the lens, where a neighbour has no ray, the lens is asked.
    """
    x = here[u + 1, 0] + 0.5 * (du * (here[u + 2, 0] - here[u, 0]) + dv * (below[u + 1, 0] - above[u + 1, 0]))
    y = here[u + 1, 1] + 0.5 * (du * (here[u + 2, 1] - here[u, 1]) + dv * (below[u + 1, 1] - above[u + 1, 1]))
    z = here[u + 1, 2] + 0.5 * (du * (here[u + 2, 2] - here[u, 2]) + dv * (below[u + 1, 2] - above[u + 1, 2]))
    size = math.sqrt(x * x + y * y + z * z)
    if size == size:
        x, y, z = x / size, y / size, z / size
    else:
        x, y, z = unproject_one(model, camera_params, u + du, v + dv)
    _turned(motion, x, y, z, d)
    return d[0] == d[0]


@kernel
def _light_on(light, normal, d):
    """Brightness of a surface seen along d, and the cosine between both."""
    facing = normal[0] * d[0] + normal[1] * d[1] + normal[2] * d[2]
    side = -1.0 if facing > 0.0 else 1.0
    shine = side * (normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2])
    return 0.62 + 0.38 * max(0.0, shine), abs(facing)


@kernel(allocates=True)
def _row(width):
    return np.empty((width + 2, 3)), np.empty(width + 2, np.int64), np.empty((width + 2, 7))


@kernel(allocates=True)
def render_rows(scene, model, camera_params, motion, start, stop, width, rgb, depth):
    """Rows start..stop of a picture: rgb (h, w, 3) in [0, 1], four samples a pixel; depth of the pixel's centre.

    Smooth texture is computed once a pixel, at the centre: it has no detail finer than two footprints. Edges of
    cells are sampled four times; so are edges of things, while inside one the samples lie on the tangent plane of
    the centre (exact but for terms of second order in the quarter of a pixel).
    """
    kinds, given, textures, colors, seeds, light = scene
    normal, trial, d, o = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    smooth, texture = np.empty(3), np.empty(3)
    for c in range(3):
        o[c] = -(motion[c] * motion[9] + motion[3 + c] * motion[10] + motion[6 + c] * motion[11])
    params = _prepared(kinds, given, o)
    prepared = kinds, params, seeds, o, d, normal, trial
    spacing = 1.0 / camera_params[0]
    above, here, below = _row(width), _row(width), _row(width)
    _look_along_row(model, camera_params, motion, prepared, start - 1.0, here)
    _look_along_row(model, camera_params, motion, prepared, start + 0.0, below)
    for v in range(start, stop):
        above, here, below = here, below, above
        _look_along_row(model, camera_params, motion, prepared, v + 1.0, below)
        for u in range(width):
            own, surface = here[1][u + 1], here[2][u + 1]
            inside = _is_inside(above, here, below, u + 1)
            if own >= 0:
                depth[v, u] = surface[6] * here[0][u + 1, 2]
                _turned(motion, here[0][u + 1, 0], here[0][u + 1, 1], here[0][u + 1, 2], d)
                _, facing = _light_on(light, surface[3:6], d)
                if textures[own] == RICH:
                    covered = 0.6 * surface[6] * spacing / math.sqrt(max(facing, 0.05))
                    _noise(seeds[own], surface[0], surface[1], surface[2], covered, smooth)
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
                if textures[hit] == RICH:
                    x, y, w = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
                    covered = 0.6 * t * spacing / math.sqrt(max(facing, 0.05))
                    if hit == own:
                        texture[:] = smooth
                    else:
                        _noise(seeds[hit], x, y, w, covered, texture)
                    _add_cells(seeds[hit], x, y, w, covered, texture)
                _add_color(colors[hit], texture, brightness, 0.25, rgb[v, u])
