"""Robust losses of a squared residual, and their second-order correction."""

import math

from epipole._jit import kernel

TRIVIAL, HUBER, SOFT_L1, CAUCHY, TRUNCATED, TUKEY = 0, 1, 2, 3, 4, 5
LEAST_CURVATURE = 0.7


@kernel
def robust_loss(kind, s, scale_sq):
    """(rho, rho') of the squared residual s; rho(s) = s for small s."""
    if kind == TRIVIAL:
        return s, 1.0
    if kind == HUBER:
        if s <= scale_sq:
            return s, 1.0
        root = math.sqrt(s * scale_sq)
        return 2.0 * root - scale_sq, scale_sq / root
    if kind == SOFT_L1:
        root = math.sqrt(1.0 + s / scale_sq)
        return 2.0 * scale_sq * (root - 1.0), 1.0 / root
    if kind == CAUCHY:
        return scale_sq * math.log1p(s / scale_sq), 1.0 / (1.0 + s / scale_sq)
    if kind == TUKEY:
        fraction = max(1.0 - s / scale_sq, 0.0)
        return scale_sq / 3.0 * (1.0 - fraction**3), fraction * fraction
    if s < scale_sq:
        return s, 1.0
    return scale_sq, 0.0


@kernel(fuse=True)
def allow_for_curvature(kind, scale_sq, ru, rv, j, j_point):
    """Triggs' second-order correction of a robust term (Triggs et al. 2000, section 4.3): J, r -> J', r'.

    Along r the curvature of the loss is only rho' + 2 s rho'' < rho'. With k = 1 + 2 s rho'' / rho' and the unit vector d
    along r, J' = (I - (1 - sqrt(k)) d d^T) J and r' = r / sqrt(k) reproduce that curvature and the gradient. Weighting alone
    (k = 1) converges linearly and takes about a third more steps; k below LEAST_CURVATURE overshoots for large residuals
    and takes more steps again (measured).
    """
    s = ru * ru + rv * rv
    if kind == HUBER:
        k = 1.0 if s <= scale_sq else 0.0
    elif kind == SOFT_L1:
        k = scale_sq / (scale_sq + s)
    elif kind == CAUCHY:
        k = (scale_sq - s) / (scale_sq + s)
    elif kind == TUKEY:
        k = 1.0 - 4.0 * s / max(scale_sq - s, 1e-12 * scale_sq)
    else:
        k = 1.0
    if k == 1.0 or s == 0.0:
        return ru, rv
    root, size = math.sqrt(max(k, LEAST_CURVATURE)), math.sqrt(s)
    du, dv = ru / size, rv / size
    for jacobian in (j, j_point):
        for i in range(jacobian.shape[1]):
            along = (1.0 - root) * (du * jacobian[0, i] + dv * jacobian[1, i])
            jacobian[0, i] -= along * du
            jacobian[1, i] -= along * dv
    return ru / root, rv / root
