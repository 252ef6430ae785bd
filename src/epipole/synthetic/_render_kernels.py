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
def _shade(kind, color, seed, x, y, z, footprint, light, rgb, scratch):
    """Colour of the surface at (x, y, z) in [0, 1], for a pixel that covers `footprint` metres of it."""
    for c in range(3):
        rgb[c] = color[c]
    if kind == RICH:
        scratch[:] = 0.0
        wavelength, weight = 1.3, 0.30
        for octave in range(NUM_OCTAVES):
            fade = min(1.0, max(0.0, 0.5 * wavelength / footprint - 1.0))
            if fade <= 0.0:
                break
            _add_noise(x / wavelength, y / wavelength, z / wavelength, seed + octave, weight * fade, scratch)
            wavelength *= 0.52
            weight *= 0.86
        size = 0.23
        for n in range(NUM_CELLS):
            fade = min(1.0, max(0.0, 0.25 * size / footprint - 1.0))
            if fade > 0.0:
                # Cells stand askew, so that none lies along a wall.
                p = (0.80 * x + 0.53 * y + 0.28 * z) / size
                q = (-0.56 * x + 0.83 * y + 0.04 * z) / size
                r = (-0.21 * x - 0.19 * y + 0.96 * z) / size
                h = _hash(
                    np.int64(math.floor(p)), np.int64(math.floor(q)), np.int64(math.floor(r)), seed + 50 + n
                )
                if (h & np.uint64(3)) == np.uint64(0):
                    for c in range(3):
                        value = float((h >> np.uint64(8 + 16 * c)) & np.uint64(0xFFFF)) / 32767.5 - 1.0
                        scratch[c] += 0.28 * fade * value
            size *= 0.43
        mean = (scratch[0] + scratch[1] + scratch[2]) / 3.0
        for c in range(3):
            rgb[c] += 0.6 * mean + 0.4 * scratch[c]
    for c in range(3):
        rgb[c] = min(1.0, max(0.0, rgb[c] * light))


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
    """Slabs (Kay and Kajiya 1986) in the box's own axes: turned by the angle p[6] about z."""
    cos, sin = math.cos(p[6]), math.sin(p[6])
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
    """March down to the first step below the ground, no farther than `nearest`, then halve by the secant rule."""
    if dz >= -1e-9:
        return math.inf
    top, bottom = p[2] + 1.4 * p[5], p[2] - 1.4 * p[5]
    first, last = max((top - oz) / dz, 1e-6), min((bottom - oz) / dz, nearest)
    if last <= first:
        return math.inf
    step = (last - first) / MARCH_STEPS
    low, above = first, oz + first * dz - p[2] - height_at(ox + first * dx, oy + first * dy, p[5], p[6], seed)
    for n in range(1, MARCH_STEPS + 1):
        high = first + n * step
        below = oz + high * dz - p[2] - height_at(ox + high * dx, oy + high * dy, p[5], p[6], seed)
        if below > 0.0:
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
        if kinds[n] == PLANE:
            t = _hit_plane(params[n], ox, oy, oz, dx, dy, dz, trial)
        elif kinds[n] == BOX:
            t = _hit_box(params[n], ox, oy, oz, dx, dy, dz, trial)
        elif kinds[n] == SPHERE:
            t = _hit_sphere(params[n], ox, oy, oz, dx, dy, dz, trial)
        else:
            t = _hit_height_field(params[n], ox, oy, oz, dx, dy, dz, seeds[n], best, trial)
        if t < best:
            best, hit = t, n
            normal[:] = trial
    return hit, best


@kernel
def render_rows(scene, model, camera_params, motion, start, stop, width, rgb, depth):
    """Rows start..stop of a picture: rgb (h, w, 3) in [0, 1], four samples a pixel; depth of the pixel's centre."""
    kinds, params, textures, colors, seeds, light = scene
    normal, trial, scratch, color = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    ox = -(motion[0] * motion[9] + motion[3] * motion[10] + motion[6] * motion[11])
    oy = -(motion[1] * motion[9] + motion[4] * motion[10] + motion[7] * motion[11])
    oz = -(motion[2] * motion[9] + motion[5] * motion[10] + motion[8] * motion[11])
    spacing = 1.0 / camera_params[0]
    for v in range(start, stop):
        for u in range(width):
            for sample in range(5):
                # The centre gives the depth; four points around it the colour.
                du = 0.0 if sample == 4 else (0.25 if sample % 2 else -0.25)
                dv = 0.0 if sample == 4 else (0.25 if sample // 2 else -0.25)
                x, y, z = unproject_one(model, camera_params, u + du, v + dv)
                if not x == x:
                    continue
                dx = motion[0] * x + motion[3] * y + motion[6] * z
                dy = motion[1] * x + motion[4] * y + motion[7] * z
                dz = motion[2] * x + motion[5] * y + motion[8] * z
                hit, t = _trace(kinds, params, seeds, ox, oy, oz, dx, dy, dz, normal, trial)
                if sample == 4:
                    depth[v, u] = t * z if hit >= 0 else math.nan
                    continue
                if hit < 0:
                    rgb[v, u, 0] += 0.25 * 0.62
                    rgb[v, u, 1] += 0.25 * 0.74
                    rgb[v, u, 2] += 0.25 * 0.88
                    continue
                facing = normal[0] * dx + normal[1] * dy + normal[2] * dz
                side = -1.0 if facing > 0.0 else 1.0
                shine = side * (normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2])
                footprint = 0.6 * t * spacing / math.sqrt(max(abs(facing), 0.05))
                _shade(
                    textures[hit], colors[hit], seeds[hit], ox + t * dx, oy + t * dy, oz + t * dz, footprint,
                    0.62 + 0.38 * max(0.0, shine), color, scratch,
                )  # fmt: skip
                for c in range(3):
                    rgb[v, u, c] += 0.25 * color[c]
