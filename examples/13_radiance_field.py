"""A radiance field and one ray in NumPy

A radiance field stores density and color in space. To render a pixel, sample the field along its ray, and
sum the colors, each weighted by the fraction of light that reaches the camera. This page trains a voxel grid
on images, and then computes one pixel in plain NumPy.
"""

import numpy as np

import epipole
from epipole.fields.nerf.voxel_field import render_voxels
from epipole.fields.nerf.voxel_trainer import VoxelTrainer
from epipole.fields.photometric import psnr
from epipole.fields.training_view import TrainingView
from epipole.synthetic import Box, Sphere, SyntheticScene, look_at, render

# The scene is a box and two spheres without a background. Pixels without depth are transparent, which marks
# their rays as empty.

scene = SyntheticScene.of(
    [
        Box(
            center=(0.0, 0.0, -0.1),
            half_size=(0.35, 0.25, 0.3),
            angle_rad=0.5,
            color=(0.65, 0.45, 0.3),
            seed=1,
        ),
        Sphere(center=(0.35, -0.3, 0.0), radius=0.2, color=(0.35, 0.55, 0.65), seed=2),
        Sphere(center=(-0.2, 0.2, 0.35), radius=0.2, color=(0.6, 0.6, 0.3), seed=3),
    ]
)
camera = epipole.Camera("PINHOLE", 96, 96, [110.0, 110.0, 47.5, 47.5])

# Render 30 views from all sides. For photographs, use `epipole.nerf("PHOTOS", "OUT", kind="grid")`, or
# `kind="hash"` for a neural field with hash tables.

views = []
for n in range(30):
    angle, up = 2.399963 * n, -0.6 + 1.3 * (n + 0.5) / 30
    cam_from_world = look_at(2.4 * np.array([np.cos(angle), np.sin(angle), up]), (0.0, 0.0, 0.0))
    image = render(scene, camera, cam_from_world)
    alpha = np.where(np.isfinite(image.depth), 255, 0).astype(np.uint8)
    views.append(TrainingView(f"{n:02d}.png", np.dstack([image.rgb, alpha]), camera, cam_from_world))
held_out, training_views = views[15], views[:15] + views[16:]

# Train the grid. Each step renders 4096 rays of the training views and updates densities and colors with the
# gradient of the error.

white, steps = np.ones(3, np.float32), 200
trainer = VoxelTrainer(training_views, white)
errors = [trainer.step(step / steps) for step in range(steps)]
print(f"mean squared error {errors[0]:.4f} in the first step, {np.mean(errors[-10:]):.5f} in the last ten")
assert np.mean(errors[-10:]) < 0.2 * errors[0]

# Render the held-out view.

truth = held_out.over(white)
rendered = trainer.render(held_out)
white_db = psnr(np.broadcast_to(white, truth.shape).astype(np.float32), truth)
print(f"held-out view: {psnr(rendered, truth):.1f} dB; a white image: {white_db:.1f} dB")
assert psnr(rendered, truth) > white_db + 8

# Next, compute one pixel near the center of this view by hand, with its ray in grid coordinates.

grid = trainer.field
column, row = 47, 50
direction = held_out.cam_from_world.inverse().rotation @ camera.unproject([[column, row]])[0]
origin = (held_out.cam_from_world.centers() - grid.low) / grid.size
cells = np.array(grid.occupied.shape)
bounds = np.stack([-origin / direction, (cells - 1e-3 - origin) / direction])
near, far = max(0.0, bounds.min(axis=0).max()), bounds.max(axis=0).min()

# Sample the ray every 0.7 voxels, and interpolate density and color between the eight corners of the cell.
# Colors depend on the direction through spherical harmonics of degree one. A softplus maps the stored value
# to the density sigma. Its shift of 4.6 makes an untrained voxel transmit 99 % of the light. The opacity of a
# sample is alpha = 1 - exp(-sigma delta). The pixel is the sum of T alpha c, where T is the transmittance in
# front of the sample, plus T times the background. The summation stops once T is below 0.001.

x, y, z = direction
basis = np.array([0.28209479, -0.48860251 * y, 0.48860251 * z, -0.48860251 * x])
transmittance, color, num_samples = 1.0, np.zeros(3), 0
for t in np.arange(near + 0.35, far, 0.7):
    sample = origin + t * direction
    i, j, k = cell = sample.astype(int)
    if not grid.occupied[i, j, k]:
        continue
    values = np.zeros(16)
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, sample - cell, 1 - (sample - cell)))
        values += weight * grid.values[grid.row_of[tuple(cell + corner)]]
    sigma = np.logaddexp(0.0, values[0] - 4.6)
    alpha = 1.0 - np.exp(-sigma * float(grid.delta))
    color += transmittance * alpha * np.maximum(0.5 + basis @ values[1:13].reshape(4, 3), 0.0)
    transmittance *= 1.0 - alpha
    num_samples += 1
    if transmittance < 1e-3:
        break
color += transmittance * white

# The compiled kernel that rendered the image computes the same value.

image, _, total = render_voxels(grid, camera, held_out.cam_from_world, white)
print(f"by hand {color.round(4)} from {num_samples} samples, rendered {image[row, column].round(4)}")
print(f"{total / (96 * 96):.1f} samples per pixel; transmittance of this pixel {100 * transmittance:.1f} %")
assert num_samples > 0 and transmittance < 0.5
assert np.allclose(color, image[row, column], atol=2e-3)
