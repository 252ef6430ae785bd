"""Gaussian splats

Thousands of small coloured ellipsoids, moved until they look like the images from where each was taken
(Kerbl et al. 2023). Then they can be drawn from anywhere. How well that works is told by an image that the
training has not seen.
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import epipole
from epipole.fields.photometric import psnr
from epipole.fields.splat.rasterizer import render as render_splats
from epipole.io import write_points_ply
from epipole.scene import depth_map_to_point_cloud
from epipole.synthetic import courtyard, courtyard_views, render

out = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
scene = out / "scene"
(scene / "images").mkdir(parents=True, exist_ok=True)

# Eighteen small images of the courtyard, whose cameras are known. With photographs of your own, all of this
# block is `epipole.splat("PHOTOS", "OUT")`: the cameras are found first.

camera = epipole.Camera("PINHOLE", 192, 128, [150.0, 150.0, 95.5, 63.5])
cams_from_world = courtyard_views(18)
images = [render(courtyard(), camera, view) for view in cams_from_world]
for n, image in enumerate(images):
    Image.fromarray(image.rgb).save(scene / "images" / f"{n:02d}.png")

# Some points on the surfaces, as structure-from-motion would give them: the first Gaussians stand there.

xyz, rgb = [], []
for image, view in zip(images, cams_from_world):
    surface = depth_map_to_point_cloud(image.depth, camera.K)
    xyz.append(view.inverse().apply(surface.points_in_cam[::101]))
    rgb.append(image.rgb[surface.mask][::101])
write_points_ply(scene / "points.ply", np.concatenate(xyz), np.concatenate(rgb))

# Cameras as nerfstudio's transforms.json: world_from_cam with y up and z backwards, pixels counted from the
# corner.

fx, fy, cx, cy = camera.params.tolist()
opengl_axes = np.diag([1.0, -1.0, -1.0, 1.0])
frames = [
    {
        "file_path": f"images/{n:02d}.png",
        "transform_matrix": (view.inverse().as_matrix() @ opengl_axes).tolist(),
    }
    for n, view in enumerate(cams_from_world)
]
intrinsics = {"w": 192, "h": 128, "fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5}
content = {**intrinsics, "ply_file_path": "points.ply", "frames": frames}
(scene / "transforms.json").write_text(json.dumps(content))

# Train for 250 steps, an image each, and hold out every sixth image. `time="5m"` trains as long as told;
# steps give the same Gaussians on any machine.

result = epipole.splat(scene, out / "splat", steps=250, max_gaussians=6000, sh_degree=1, test_every=6)
print(result)
print(f"PSNR of held-out views: {result.summary['psnr']:.1f} dB")
assert len(result.cloud) <= 6000 and result.summary["psnr"] > 20

# The same number by hand. Draw from the camera of a view that was held out, and compare with its image: 20
# dB is a root mean square error of a tenth of the range of brightness, and each 6 dB more are half of that.

black = np.zeros(3, np.float32)
held_out, truth = 6, images[6].rgb.astype(np.float32) / 255
rendered = render_splats(result.cloud, camera, cams_from_world[held_out]).over(black)
own = psnr(rendered, truth)
gray = psnr(np.broadcast_to(truth.mean(axis=(0, 1)), truth.shape).astype(np.float32), truth)
print(f"view {held_out}: {own:.1f} dB; one colour everywhere: {gray:.1f} dB")
metrics = json.loads((out / "splat" / "metrics.json").read_text())
given = {view["name"]: view["psnr"] for view in metrics["views"]}
assert abs(own - given["images/06.png"]) < 0.5
assert own > gray + 4

# Depth comes with it: along the optical axis, weighed by what each Gaussian adds to the pixel.

seen = render_splats(result.cloud, camera, cams_from_world[held_out])
depth = seen.depth / np.maximum(seen.coverage, 1e-6)
true_depth = images[held_out].depth
solid = np.isfinite(true_depth) & (seen.coverage > 0.9)
off = np.abs(depth[solid] / true_depth[solid] - 1.0)
print(f"depth off by {100 * np.median(off):.1f} % (median of {100 * solid.mean():.0f} % of the pixels)")
assert np.median(off) < 0.05

# Side by side: the image, and what was drawn. `epipole.render("OUT", "round.mp4")` draws a film of the
# whole.

both = np.concatenate([truth, np.clip(rendered, 0, 1)], axis=1)
Image.fromarray((255 * both).astype(np.uint8)).save(out / "held_out.png")
