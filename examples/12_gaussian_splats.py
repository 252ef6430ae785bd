"""Gaussian splatting

Gaussian splatting (Kerbl et al. 2023) represents a scene as thousands of colored ellipsoids, and optimizes
them until their renderings match the training images. The scene can then be rendered from any viewpoint.
Held-out views measure the quality.
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

# Render 18 small images of the courtyard with known camera poses. For your own photographs,
# `epipole.splat("PHOTOS", "OUT")` replaces these steps: it estimates the poses first.

camera = epipole.Camera("PINHOLE", 192, 128, [150.0, 150.0, 95.5, 63.5])
cams_from_world = courtyard_views(18)
images = [render(courtyard(), camera, view) for view in cams_from_world]
for n, image in enumerate(images):
    Image.fromarray(image.rgb).save(scene / "images" / f"{n:02d}.png")

# Sample points on the surfaces, similar to the points of structure-from-motion. They initialize the
# Gaussians.

xyz, rgb = [], []
for image, view in zip(images, cams_from_world):
    surface = depth_map_to_point_cloud(image.depth, camera.K)
    xyz.append(view.inverse().apply(surface.points_in_cam[::101]))
    rgb.append(image.rgb[surface.mask][::101])
write_points_ply(scene / "points.ply", np.concatenate(xyz), np.concatenate(rgb))

# Write the cameras in the transforms.json format of nerfstudio. Its poses are world_from_cam with y up and z
# backwards, and its pixel coordinates start at the image corner.

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
transforms = {**intrinsics, "ply_file_path": "points.ply", "frames": frames}
(scene / "transforms.json").write_text(json.dumps(transforms))

# Train for 250 steps of one image each, and hold out every sixth image. With `steps`, the result is the same
# on any machine. With `time="5m"` instead, training stops after five minutes.

result = epipole.splat(scene, out / "splat", steps=250, max_gaussians=6000, sh_degree=1, test_every=6)
print(result)
print(f"PSNR of held-out views: {result.summary['psnr']:.1f} dB")
assert len(result.cloud) <= 6000 and result.summary["psnr"] > 20

# Compute the PSNR of one held-out view. A PSNR of 20 dB is an RMS error of one tenth of the brightness range,
# and each further 6 dB halves the error.

black = np.zeros(3, np.float32)
held_out, truth = 6, images[6].rgb.astype(np.float32) / 255
rendered = render_splats(result.cloud, camera, cams_from_world[held_out]).over(black)
psnr_db = psnr(rendered, truth)
constant_db = psnr(np.broadcast_to(truth.mean(axis=(0, 1)), truth.shape).astype(np.float32), truth)
print(f"view {held_out}: {psnr_db:.1f} dB; constant color: {constant_db:.1f} dB")
metrics = json.loads((out / "splat" / "metrics.json").read_text())
reported_db = {view["name"]: view["psnr"] for view in metrics["views"]}
assert abs(psnr_db - reported_db["images/06.png"]) < 0.5
assert psnr_db > constant_db + 4

# The rasterizer also renders the depth along the optical axis, weighted by the contribution of each Gaussian
# to the pixel.

rendering = render_splats(result.cloud, camera, cams_from_world[held_out])
depth = rendering.depth / np.maximum(rendering.coverage, 1e-6)
true_depth = images[held_out].depth
is_valid = np.isfinite(true_depth) & (rendering.coverage > 0.9)
depth_errors = np.abs(depth[is_valid] / true_depth[is_valid] - 1.0)
print(
    f"median depth error {100 * np.median(depth_errors):.1f} % on {100 * is_valid.mean():.0f} % of the pixels"
)
assert np.median(depth_errors) < 0.05

# Save the image and the rendering side by side. `epipole.render("OUT", "orbit.mp4")` renders a video.

comparison = np.concatenate([truth, np.clip(rendered, 0, 1)], axis=1)
Image.fromarray((255 * comparison).astype(np.uint8)).save(out / "held_out.png")
