"""View and share results

`epipole.view` shows a result in the browser. `epipole.share` writes a self-contained HTML file, which you can
send to others: it needs no server and loads no other files.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import epipole
from epipole.fields.splat.rasterizer import render as render_splats
from epipole.io.gaussians.ply import read_gaussian_ply, write_gaussian_ply
from epipole.scene import depth_map_to_point_cloud
from epipole.scene.gaussian_cloud import DC, GaussianCloud
from epipole.synthetic import courtyard, courtyard_views, render

out = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
out.mkdir(parents=True, exist_ok=True)

# Create a scene. Usually `epipole.splat` trains the Gaussians from photographs. To save time, this page puts
# one Gaussian on the surface at every ninth pixel of five rendered images.

camera = epipole.Camera("PINHOLE", 320, 240, [250.0, 250.0, 159.5, 119.5])
views = courtyard_views(5)
positions, colors, sizes = [], [], []
for view in views:
    image = render(courtyard(), camera, view)
    surface = depth_map_to_point_cloud(image.depth, camera.K)
    points_in_cam = surface.points_in_cam[::9]
    positions.append(view.inverse().apply(points_in_cam))
    colors.append(image.rgb[surface.mask][::9] / 255)
    sizes.append(1.5 * points_in_cam[:, 2] / camera.focal_px)

# A Gaussian has a mean, three standard deviations (as logarithms), a rotation, an opacity (as a logit) and a
# color in spherical harmonics. Degree 0 is the same in all directions.

means = np.concatenate(positions)
n = len(means)
cloud = GaussianCloud(
    means_in_world=means.astype(np.float32),
    log_scales=np.log(np.repeat(np.concatenate(sizes)[:, None], 3, axis=1)).astype(np.float32),
    quats_wxyz=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
    opacity_logits=np.full(n, 2.0, np.float32),
    sh=((np.concatenate(colors)[:, None, :] - 0.5) / DC).astype(np.float32),
)
print(cloud)

# Render the Gaussians from a viewpoint between the cameras. They cover most of the image, with the right
# colors.

novel_view = courtyard_views(9)[3]
rendered = render_splats(cloud, camera, novel_view)
truth = render(courtyard(), camera, novel_view).rgb / 255
is_covered = rendered.coverage > 0.9
error = np.abs(rendered.color[is_covered] - truth[is_covered]).mean()
print(f"{100 * is_covered.mean():.0f} % covered, mean color error {error:.3f}")
assert is_covered.mean() > 0.5 and error < 0.15

# Write the Gaussians to a `.ply` file that other programs can read. `epipole.convert` also writes `.spz`,
# `.sog`, `.splat` and compressed PLY.

write_gaussian_ply(out / "scene.ply", cloud)
assert len(read_gaussian_ply(out / "scene.ply")) == n
epipole.convert(out / "scene.ply", out / "scene.spz")
ply, spz = ((out / name).stat().st_size for name in ("scene.ply", "scene.spz"))
print(f"ply {ply / 1e6:.1f} MB, spz {spz / 1e6:.1f} MB")
assert spz < 0.3 * ply

# Write the page. If there are more than `share_max` Gaussians, `share` merges them down to this number.

page = epipole.share(out / "scene.ply", out / "scene.html")
html, num_bytes = page.read_text(encoding="utf-8"), page.stat().st_size
print(f"{page.name}: {num_bytes / 1e6:.1f} MB")
assert num_bytes > 32 * n
assert 'src="http' not in html and 'import("http' not in html

smaller = epipole.share(out / "scene.ply", out / "small.html", share_max=2000)
assert smaller.stat().st_size < 0.5 * num_bytes

# The viewer shows models, trajectories, depth maps and Gaussians. It listens on localhost only. With
# `block=False`, `view` returns a handle immediately.

handle = epipole.view(out / "scene.ply", block=False)
print("viewer:", handle.url)
assert handle.url.startswith("http://127.0.0.1:")
handle.stop()
