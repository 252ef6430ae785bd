"""3D Gaussian Splatting written as the equations stand: every Gaussian at every pixel, in double precision."""

import numpy as np

from epipole.geometry import Rotation3

SH1, SH2 = (
    0.4886025119029199,
    (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396),
)
SH3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


def basis(d, count):
    x, y, z = d.T
    columns = [np.full(len(d), 0.28209479177387814), -SH1 * y, SH1 * z, -SH1 * x]
    columns += [
        SH2[0] * x * y,
        SH2[1] * y * z,
        SH2[2] * (2 * z * z - x * x - y * y),
        SH2[3] * x * z,
        SH2[4] * (x * x - y * y),
    ]
    columns += [
        SH3[0] * y * (3 * x * x - y * y), SH3[1] * x * y * z, SH3[2] * y * (4 * z * z - x * x - y * y),
        SH3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y), SH3[4] * x * (4 * z * z - x * x - y * y),
        SH3[5] * z * (x * x - y * y), SH3[6] * x * (x * x - 3 * y * y),
    ]  # fmt: skip
    return np.stack(columns[:count], axis=1)


def plain_render(arrays, camera, cam_from_world, blur=0.3, antialiased=False, near=0.01):
    """(h, w, 3) color times coverage, (h, w) depth times coverage, (h, w) coverage; arrays as in a cloud, any precision."""
    means, log_scales, quats, logits, sh = (np.asarray(a, np.float64) for a in arrays)
    f, c = camera.K[[0, 1], [0, 1]], camera.K[:2, 2]
    rotation, there = cam_from_world.rotation, cam_from_world.apply(means)
    order = np.argsort(there[:, 2].astype(np.float32), kind="stable")
    axes = (
        Rotation3.from_quat_wxyz(quats / np.linalg.norm(quats, axis=1, keepdims=True)).matrix
        * np.exp(log_scales)[:, None]
    )
    spread = axes @ np.swapaxes(axes, 1, 2)
    reach = 1.3 * 0.5 * np.array([camera.width, camera.height]) / f
    direction = means - cam_from_world.centers()
    harmonics = basis(direction / np.linalg.norm(direction, axis=1, keepdims=True), sh.shape[1])
    colors = np.maximum(0.5 + np.einsum("nk,nkc->nc", harmonics, sh), 0.0)
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    color, depth, left = np.zeros((*u.shape, 3)), np.zeros(u.shape), np.ones(u.shape)
    for n in order:
        x, y, z = there[n]
        if not z > near:
            continue
        fixed = np.clip(np.array([x, y]) / z, -reach, reach)
        jac = np.array([[f[0] / z, 0, -f[0] * fixed[0] / z], [0, f[1] / z, -f[1] * fixed[1] / z]]) @ rotation
        seen = jac @ spread[n] @ jac.T
        wide = seen + blur * np.eye(2)
        opacity = 1 / (1 + np.exp(-logits[n]))
        if antialiased:
            opacity *= np.sqrt(max(np.linalg.det(seen), 0.0) / np.linalg.det(wide))
        a, b, _, d = np.linalg.inv(wide).ravel()
        dx, dy = u - (f[0] * x / z + c[0]), v - (f[1] * y / z + c[1])
        alpha = opacity * np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + d * dy * dy))
        alpha = np.where(alpha >= 1 / 255, np.minimum(alpha, 0.99), 0.0)
        weight = alpha * left
        color += weight[..., None] * colors[n]
        depth += weight * z
        left = left - weight
    return color, depth, 1 - left
