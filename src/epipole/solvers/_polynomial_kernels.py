"""All real roots of a polynomial, for the minimal solvers; no allocation."""

import math

import numpy as np

from epipole._jit import kernel

MOST_DEGREE = 15
UNEVEN = 0.4871  # where intervals are split: halving them would hit integer roots, zero first


@kernel(allocates=True)
def roots_workspace():
    """Working arrays of `real_roots`."""
    return np.empty((4, MOST_DEGREE + 2)), np.empty((MOST_DEGREE + 1, 3)), np.empty((MOST_DEGREE + 2, 4))


@kernel
def _sturm_chain(poly, degree, remainders, quotients):
    """Sturm sequence of poly (ascending): f_0 = poly, f_1 = poly', f_{i-1} = (a x + b) f_i - c f_{i+1}, c > 0.

    Writes a, b, c of each step to quotients, then the sign of the last, constant member; returns the number of steps.
    Members are divided by the magnitude of their leading coefficients.
    """
    above, f, below = remainders[0], remainders[1], remainders[2]
    scale = 1.0 / abs(poly[degree])
    for k in range(degree + 1):
        above[k] = poly[k] * scale
    for k in range(degree):
        f[k] = above[k + 1] * (k + 1) / degree
    steps, size = 0, degree - 1
    while True:
        a = above[size + 1] / f[size]
        b = (above[size] - (a * f[size - 1] if size > 0 else 0.0)) / f[size]
        quotients[steps, 0], quotients[steps, 1] = a, b
        steps += 1
        if size == 0:
            break
        below[0] = b * f[0] - above[0]
        for k in range(1, size):
            below[k] = a * f[k - 1] + b * f[k] - above[k]
        largest = 0.0
        for k in range(size):
            largest = max(largest, abs(below[k]))
        # Later members lose leading coefficients only if roots coincide: the chain ends there.
        if not abs(below[size - 1]) > 1e-13 * largest:
            break
        c = abs(below[size - 1])
        for k in range(size):
            below[k] /= c
        quotients[steps - 1, 2] = c
        above, f, below = f, below, above
        size -= 1
    quotients[steps - 1, 2] = f[size]
    return steps


@kernel
def _sign_changes(quotients, steps, x):
    """Sign changes of the Sturm sequence at x, evaluated from its last member upward."""
    later, value = 0.0, quotients[steps - 1, 2]
    later, value = value, (quotients[steps - 1, 0] * x + quotients[steps - 1, 1]) * value
    changes = 1 if (value < 0.0) != (later < 0.0) else 0
    for i in range(steps - 2, -1, -1):
        later, value = value, (quotients[i, 0] * x + quotients[i, 1]) * value - quotients[i, 2] * later
        if (value < 0.0) != (later < 0.0):
            changes += 1
    return changes


@kernel
def _polish(poly, degree, low, high):
    """The root of poly between stretch(low) and stretch(high), where it changes sign.

    Newton's method, with bisection if it leaves the bracket or does not halve its step.
    """
    is_low_positive = _horner(poly, degree, _stretch(low)) > 0.0
    t, last = 0.5 * (low + high), math.inf
    x = _stretch(t)
    for _ in range(100):
        value, slope = poly[degree], 0.0
        for k in range(degree - 1, -1, -1):
            slope = slope * x + value
            value = value * x + poly[k]
        if (value > 0.0) == is_low_positive:
            low = t
        else:
            high = t
        step = value / slope if slope != 0.0 else math.inf
        after = x - step
        t = after / (1.0 + abs(after))
        if not (low <= t <= high and abs(step) <= 0.5 * last):
            t = 0.5 * (low + high)
            after = _stretch(t)
        last = abs(after - x)
        x = after
        if last <= 1e-15 * (1.0 + abs(x)):
            break
    return x


@kernel
def _horner(poly, degree, x):
    value = poly[degree]
    for k in range(degree - 1, -1, -1):
        value = value * x + poly[k]
    return value


@kernel
def _stretch(t):
    """Map (-1, 1) to the real line, so that large roots take as few bisections as small ones."""
    return t / (1.0 - abs(t))


@kernel
def real_roots(poly, work, roots):
    """All real roots of poly (ascending coefficients), ascending; returns their number.

    Sturm's theorem (1829): the number of distinct roots between x and y is the number of sign changes that the sequence loses.
    Bisection isolates each root, Newton's method refines it. Roots that coincide within rounding count once.
    """
    return roots_within(poly, math.inf, work, roots)


@kernel
def roots_within(poly, radius, work, roots):
    """Real roots with magnitude up to the radius."""
    remainders, quotients, stack = work
    degree, biggest, scaled = len(poly) - 1, 0.0, remainders[3]
    for k in range(len(poly)):
        biggest = max(biggest, abs(poly[k]))
    if not (biggest > 0.0 and biggest < np.inf):
        return 0
    while degree > 0 and abs(poly[degree]) <= 1e-30 * biggest:
        degree -= 1
    if degree == 0:
        return 0
    # x = unit * y, such that the magnitudes of the roots y multiply to one: the sequence is far better conditioned.
    unit = abs(poly[0] / poly[degree]) ** (1.0 / degree) if poly[0] != 0.0 else 1.0
    factor, biggest = 1.0, 0.0
    for k in range(degree + 1):
        scaled[k] = poly[k] * factor
        factor *= unit
        biggest = max(biggest, abs(scaled[k]))
    if not (biggest > 0.0 and biggest < np.inf and abs(scaled[degree]) > 0.0):
        return 0
    steps = _sturm_chain(scaled, degree, remainders, quotients)
    # All roots are smaller than 1 + max |a_k / a_n| (Cauchy).
    size = min(1.0 + biggest / abs(scaled[degree]), radius / unit)
    count = _isolated_roots(scaled, degree, quotients, steps, size / (1.0 + size), stack, roots)
    for k in range(count):
        roots[k] *= unit
    return count


@kernel
def _isolated_roots(poly, degree, quotients, steps, bound, stack, roots):
    """Roots between stretch(-bound) and stretch(bound), ascending, by bisection with a stack of intervals."""
    stack[0, 0], stack[0, 1] = -bound, bound
    stack[0, 2] = _sign_changes(quotients, steps, _stretch(-bound))
    stack[0, 3] = _sign_changes(quotients, steps, _stretch(bound))
    count, waiting = 0, 1
    while waiting > 0 and count < degree:
        waiting -= 1
        low, high, before, after = stack[waiting]
        if before - after < 0.5:
            continue
        if before - after < 1.5 or high - low < 1e-13:
            roots[count] = _polish(poly, degree, low, high)
            count += 1
            continue
        middle = low + UNEVEN * (high - low)
        changes = np.float64(_sign_changes(quotients, steps, _stretch(middle)))
        if changes - after > 0.5 and waiting < len(stack):
            stack[waiting] = (middle, high, changes, after)
            waiting += 1
        if before - changes > 0.5 and waiting < len(stack):
            stack[waiting] = (low, middle, before, changes)
            waiting += 1
    return count


@kernel
def cubic_roots(c3, c2, c1, c0, roots):
    """All real roots of c3 x^3 + c2 x^2 + c1 x + c0 (unsorted, double roots twice); returns their number.

    Viete's trigonometric form for three roots, Cardano's for one, then Newton's method (Press et al. 2007, section 5.6). If c3
    is negligible, the roots are those of the quadratic.
    """
    biggest = max(abs(c3), abs(c2), abs(c1), abs(c0))
    if not (biggest > 0.0 and biggest < np.inf):
        return 0
    if abs(c3) < 1e-14 * biggest:
        if abs(c2) < 1e-14 * biggest:
            if abs(c1) < 1e-14 * biggest:
                return 0
            roots[0] = -c0 / c1
            return 1
        discriminant = c1 * c1 - 4.0 * c2 * c0
        if discriminant < 0.0:
            return 0
        q = -0.5 * (c1 + math.copysign(math.sqrt(discriminant), c1))
        roots[0] = q / c2
        roots[1] = c0 / q if q != 0.0 else 0.0
        return 2
    a, b, c = c2 / c3, c1 / c3, c0 / c3
    q, r = (a * a - 3.0 * b) / 9.0, (2.0 * a * a * a - 9.0 * a * b + 27.0 * c) / 54.0
    if r * r < q * q * q:
        angle, root = math.acos(r / math.sqrt(q * q * q)), -2.0 * math.sqrt(q)
        for k in range(3):
            roots[k] = root * math.cos((angle + 2.0 * math.pi * (k - 1)) / 3.0) - a / 3.0
        count = 3
    else:
        s = -math.copysign((abs(r) + math.sqrt(r * r - q * q * q)) ** (1.0 / 3.0), r)
        roots[0] = s + (q / s if s != 0.0 else 0.0) - a / 3.0
        count = 1
    for k in range(count):
        x = roots[k]
        for _ in range(2):
            slope = (3.0 * x + 2.0 * a) * x + b
            if slope == 0.0:
                break
            x -= (((x + a) * x + b) * x + c) / slope
        roots[k] = x
    return count
