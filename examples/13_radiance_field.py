"""A radiance field, and one ray by hand

A field of density and colour in space, drawn by marching along rays: what a pixel sees is the sum of the
colours on its way, each weighed by how much light gets through to it. Here the field is a grid of voxels,
learnt from images; then one pixel is computed again in plain NumPy.
"""

import numpy as np

import epipole
from epipole.fields.nerf.voxel_field import render_voxels
from epipole.fields.nerf.voxel_trainer import VoxelTrainer
from epipole.fields.photometric import psnr
from epipole.fields.training_view import TrainingView
from epipole.synthetic import Box, Sphere, SyntheticScene, look_at, render

# A box and two balls before nothing: where the rendering has no depth, images are transparent. Such
# silhouettes tell at once where nothing is.

things = SyntheticScene.of(
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

# Thirty views from all around. With photographs: `epipole.nerf("PHOTOS", "OUT", kind="grid")`, or
# `kind="hash"` for a neural field of hashed tables.

views = []
for n in range(30):
    angle, up = 2.399963 * n, -0.6 + 1.3 * (n + 0.5) / 30
    position = look_at(2.4 * np.array([np.cos(angle), np.sin(angle), up]), (0.0, 0.0, 0.0))
    image = render(things, camera, position)
    alpha = np.where(np.isfinite(image.depth), 255, 0).astype(np.uint8)
    views.append(TrainingView(f"{n:02d}.png", np.dstack([image.rgb, alpha]), camera, position))
held_out, learnt = views[15], views[:15] + views[16:]

# Train: each step follows 4096 rays of all images, and moves densities and colours against the error.

white, steps = np.ones(3, np.float32), 200
trainer = VoxelTrainer(learnt, white)
errors = [trainer.step(step / steps) for step in range(steps)]
print(f"mean squared error {errors[0]:.4f} at first, {np.mean(errors[-10:]):.5f} at the end")
assert np.mean(errors[-10:]) < 0.2 * errors[0]

# The view that was held out.

truth = held_out.over(white)
rendered = trainer.render(held_out)
empty = psnr(np.broadcast_to(white, truth.shape).astype(np.float32), truth)
print(f"held-out view: {psnr(rendered, truth):.1f} dB; a white image: {empty:.1f} dB")
assert psnr(rendered, truth) > empty + 8

# Now one pixel by hand: the ray through the middle of that image, in the grid's own coordinates.

grid = trainer.field
column, row = 47, 50
direction = held_out.cam_from_world.inverse().rotation @ camera.unproject([[column, row]])[0]
origin = (held_out.cam_from_world.centers() - grid.low) / grid.size
cells = np.array(grid.occupied.shape)
walls = np.stack([-origin / direction, (cells - 1e-3 - origin) / direction])
near, far = max(0.0, walls.min(axis=0).max()), walls.max(axis=0).min()

# Samples stand 0.7 voxels apart. Between the eight corners of its cell a sample's density and colour are
# interpolated; colours depend on the direction by harmonics of degree one. Density sigma lets exp(-sigma
# delta) of the light through: alpha = 1 - exp(-sigma delta). What is stored goes through a softplus, shifted
# by 4.6 so that what is not known lets 99 in 100 through. The pixel is the sum of T alpha c with T the light
# that is left, until that is a thousandth, and T of the background.

x, y, z = direction
basis = np.array([0.28209479, -0.48860251 * y, 0.48860251 * z, -0.48860251 * x])
left, colour, num_samples = 1.0, np.zeros(3), 0
for t in np.arange(near + 0.35, far, 0.7):
    at = origin + t * direction
    i, j, k = cell = at.astype(int)
    if not grid.occupied[i, j, k]:
        continue
    values = np.zeros(16)
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, at - cell, 1 - (at - cell)))
        values += weight * grid.values[grid.row_of[tuple(cell + corner)]]
    sigma = np.logaddexp(0.0, values[0] - 4.6)
    alpha = 1.0 - np.exp(-sigma * float(grid.delta))
    colour += left * alpha * np.maximum(0.5 + basis @ values[1:13].reshape(4, 3), 0.0)
    left *= 1.0 - alpha
    num_samples += 1
    if left < 1e-3:
        break
colour += left * white

# The kernel that drew the image says the same.

image, _, total = render_voxels(grid, camera, held_out.cam_from_world, white)
print(f"by hand {colour.round(4)} from {num_samples} samples, drawn {image[row, column].round(4)}")
print(f"{total / (96 * 96):.1f} samples a pixel; {100 * left:.1f} % of the background shows through this one")
assert num_samples > 0 and left < 0.5
assert np.allclose(colour, image[row, column], atol=2e-3)
