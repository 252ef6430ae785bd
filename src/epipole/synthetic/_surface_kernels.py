"""Surfaces: intersections of rays with planes, boxes, spheres and height fields, and solid textures.

The texture is a sum of octaves of value noise on hashed lattices (Perlin 1985 for the idea, a 64-bit mix for the hash) and of hashed
cells with hard edges. An octave fades out when its wavelength falls below two pixel footprints, like the blur of optics and sensor;
otherwise details would alias between views.
"""

import math

import numpy as np

from epipole._jit import kernel

MARCH_STEPS = 24
NUM_OCTAVES, NUM_CELLS = 9, 4


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
                fraction = weight * (u if a else 1.0 - u) * (v if b else 1.0 - v) * (w if c else 1.0 - w)
                h = _hash(np.int64(i) + a, np.int64(j) + b, np.int64(k) + c, seed)
                for channel in range(3):
                    value = float((h >> np.uint64(16 * channel)) & np.uint64(0xFFFF)) / 32767.5 - 1.0
                    rgb[channel] += fraction * value


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
    """Height of a wavy ground: two octaves of noise."""
    broad = _noise_2d(x / wavelength, y / wavelength, seed)
    return amplitude * (broad + 0.35 * _noise_2d(2.7 * x / wavelength, 2.7 * y / wavelength, seed + 1))


@kernel
def fill_noise(seed, x, y, z, footprint, out):
    """The smooth part of the rich texture, for a pixel that covers `footprint` meters."""
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
def add_cells(seed, x, y, z, footprint, out):
    """The part with hard edges: a random quarter of the cells, in four sizes."""
    # Cells are rotated, so that none is aligned with a wall.
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
def add_color(color, texture, light, weight, rgb):
    """Rgb += weight * the shaded color of a surface, with `texture` added to its base color."""
    mean = (texture[0] + texture[1] + texture[2]) / 3.0
    for c in range(3):
        rgb[c] += weight * min(1.0, max(0.0, (color[c] + 0.8 * mean + 0.2 * texture[c]) * light))


@kernel
def hit_plane(p, ox, oy, oz, dx, dy, dz, normal):
    """Distance along the ray to a plane, infinite if missed; writes the normal."""
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
def hit_box(p, ox, oy, oz, dx, dy, dz, normal):
    """Distance along the ray to a box, by slabs (Kay and Kajiya 1986) in its own axes (cosine p[7] and sine p[8] of the angle)."""
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
def hit_sphere(p, ox, oy, oz, dx, dy, dz, normal):
    """Distance along the ray to a sphere, infinite if missed; writes the normal."""
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
def hit_height_field(p, ox, oy, oz, dx, dy, dz, seed, nearest, normal):
    """Distance along the ray to a height field: march to the first point below it, up to `nearest`, then refine by the secant rule.

    The slope is at most p[7], so a step of gap / (fall + slope * horizontal distance) cannot cross the ground. Steps have a lower
    bound, since the secant rule needs a point below.
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
            # Alternate secant and bisection, for safe and fast convergence.
            fraction = above / (above - below) if k % 3 and above > below else 0.5
            t = low + fraction * (high - low)
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
