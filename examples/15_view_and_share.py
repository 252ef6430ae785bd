"""View and share

`epipole.view` shows whatever a folder holds in the browser. `epipole.share` writes a page of its own: one
HTML file with the scene in it, which loads nothing, needs no server, and can be sent to anybody.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import epipole
from epipole.fields.splat.rasterizer import render as draw
from epipole.io.gaussians.ply import read_gaussian_ply, write_gaussian_ply
from epipole.scene import depth_map_to_point_cloud
from epipole.scene.gaussian_cloud import DC, GaussianCloud
from epipole.synthetic import courtyard, courtyard_views, render

out = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
out.mkdir(parents=True, exist_ok=True)

# A scene to show. `epipole.splat` trains one from photographs; to be quick, Gaussians are put here on the
# surfaces that five rendered images see: one for each ninth pixel.

camera = epipole.Camera("PINHOLE", 320, 240, [250.0, 250.0, 159.5, 119.5])
views = courtyard_views(5)
positions, colours, sizes = [], [], []
for view in views:
    image = render(courtyard(), camera, view)
    surface = depth_map_to_point_cloud(image.depth, camera.K)
    points_in_cam = surface.points_in_cam[::9]
    positions.append(view.inverse().apply(points_in_cam))
    colours.append(image.rgb[surface.mask][::9] / 255)
    sizes.append(1.5 * points_in_cam[:, 2] / camera.focal_px)

# A Gaussian is a place, three deviations (as logarithms), a rotation, an opacity (as a logit) and a colour in
# spherical harmonics, of which degree 0 is the same from everywhere.

means = np.concatenate(positions)
n = len(means)
cloud = GaussianCloud(
    means_in_world=means.astype(np.float32),
    log_scales=np.log(np.repeat(np.concatenate(sizes)[:, None], 3, axis=1)).astype(np.float32),
    quats_wxyz=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
    opacity_logits=np.full(n, 2.0, np.float32),
    sh=((np.concatenate(colours)[:, None, :] - 0.5) / DC).astype(np.float32),
)
print(cloud)

# It looks like the scene: drawn from between the cameras, most of the image is covered, with the right
# colours.

between = courtyard_views(9)[3]
rendered = draw(cloud, camera, between)
truth = render(courtyard(), camera, between).rgb / 255
full = rendered.coverage > 0.9
off = np.abs(rendered.colour[full] - truth[full]).mean()
print(f"{100 * full.mean():.0f} % covered, colours off by {off:.3f} of 1")
assert full.mean() > 0.5 and off < 0.15

# Files of Gaussians that other programs read: `.ply` here; `epipole.convert` makes `.spz`, `.sog`, `.splat`
# and compressed PLY.

write_gaussian_ply(out / "scene.ply", cloud)
assert len(read_gaussian_ply(out / "scene.ply")) == n
epipole.convert(out / "scene.ply", out / "scene.spz")
ply, spz = ((out / name).stat().st_size for name in ("scene.ply", "scene.spz"))
print(f"ply {ply / 1e6:.1f} MB, spz {spz / 1e6:.1f} MB")
assert spz < 0.3 * ply

# The page. It holds the Gaussians themselves, the most visible if there are more than `share_max`.

page = epipole.share(out / "scene.ply", out / "scene.html")
html, num_bytes = page.read_text(encoding="utf-8"), page.stat().st_size
print(f"{page.name}: {num_bytes / 1e6:.1f} MB")
assert num_bytes > 32 * n
assert 'src="http' not in html and 'import("http' not in html

smaller = epipole.share(out / "scene.ply", out / "small.html", share_max=2000)
assert smaller.stat().st_size < 0.5 * num_bytes

# The viewer in the browser shows models of `reconstruct`, paths of `slam`, depth of `stereo` and Gaussians
# alike. It listens on this machine alone; `block=False` gives the script its handle back.

handle = epipole.view(out / "scene.ply", block=False)
print("watch at", handle.url)
assert handle.url.startswith("http://127.0.0.1:")
handle.stop()
