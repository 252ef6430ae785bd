"""A bundle problem with a known answer, of any number of sensors and cameras."""

from dataclasses import replace

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3
from epipole.optim import BundleProblem, free_params_mask
from epipole.synthetic import look_at

NOISE_PX = 0.5


def ring(rng, num_frames=8, num_points=150, num_sensors=1):
    """Cameras on a ring around a ball of points; every point seen by five frames, each with all sensors."""
    camera = Camera(CameraModel.RADIAL, 1000, 800, np.array([900.0, 499.5, 399.5, -0.05, 0.01]))
    angles = 2 * np.pi * np.arange(num_frames) / num_frames
    frames = [look_at((6 * np.cos(a), 6 * np.sin(a), 0.5), (0, 0, 0)) for a in angles]
    rig_from_world = Rigid3(np.stack([f.rotation for f in frames]), np.stack([f.translation for f in frames]))
    xi = np.zeros((num_sensors, 6))
    xi[1:] = 0.05 * rng.normal(size=(num_sensors - 1, 6))
    cam_from_rig = Rigid3.exp(xi)
    points = rng.uniform(-1, 1, (num_points, 3))
    frame, sensor, pixels, offsets = [], [], [], [0]
    for point in points:
        for f in np.sort(rng.permutation(num_frames)[:5]):
            for s in range(num_sensors):
                in_cam = (cam_from_rig[s] @ rig_from_world[f]).apply(point)
                frame.append(f)
                sensor.append(s)
                pixels.append(camera.project(in_cam[None])[0])
        offsets.append(len(frame))
    pixels = np.array(pixels) + NOISE_PX * rng.normal(size=(len(pixels), 2))
    model = np.array([int(camera.model)], np.int32)
    truth = BundleProblem(
        rig_from_world,
        cam_from_rig,
        model,
        camera.padded_params()[None],
        points,
        np.array(offsets, np.int64),
        np.array(frame, np.int32),
        np.array(sensor, np.int32),
        np.zeros(len(frame), np.int32),
        pixels,
        np.ones((num_frames, 6)),
        free_params_mask(model),
        np.ones(num_points),
    )
    start = replace(
        truth,
        rig_from_world=Rigid3.exp(0.01 * rng.normal(size=(num_frames, 6))) @ rig_from_world,
        camera_params=truth.camera_params * [[1.03, 1, 1, 0, 0, *[1] * 7]],
        points_in_world=points + 0.02 * rng.normal(size=points.shape),
    )
    return truth, start
