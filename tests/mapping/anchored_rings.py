"""Rings of cameras around points, adjusted, in a unit that is not the meter."""

from dataclasses import dataclass, replace

import numpy as np

from epipole.geometry import Rotation3, Similarity3, align_points
from epipole.mapping import Freedom, adjust_reconstruction
from epipole.scene import Reconstruction
from epipole.synthetic.problems import bundle_problem


@dataclass(frozen=True)
class Ring:
    """A model, the truth, and the meters of the model's unit."""

    model: Reconstruction
    truth: Reconstruction
    meters: float

    def length(self, ends, views, name="L", meters=None, noise=None):
        """Lines of a file of lengths: both ends in these images."""
        camera, cams, out = self.truth.cameras[0], self.truth.cams_from_world(), []
        meters = float(np.linalg.norm(ends[0] - ends[1])) if meters is None else meters
        for end, position in zip("ab", ends, strict=True):
            for i in views:
                x, y = camera.project(cams[i].apply(position[None]))[0] + (
                    0 if noise is None else noise.normal(size=2)
                )
                out.append(f"{name} {meters} {end} {self.truth.images.name[i]} {x} {y}\n")
        return "".join(out)


def ring(seed=0, count=24, noise_px=0.5):
    truth = bundle_problem(count, 200, 6, noise_px, seed).truth
    truth = replace(truth, frames=replace(truth.frames, timestamp_s=np.arange(count) * 0.5))
    model, _ = adjust_reconstruction(truth, freedom=Freedom(focal=False, distortion=False))
    rng = np.random.default_rng(seed)
    rotation = Rotation3.exp(rng.normal(size=3)).matrix
    model = model.transformed(Similarity3(np.asarray(0.4), rotation, rng.normal(size=3)))
    fit = align_points(model.camera_centers_in_world(), truth.camera_centers_in_world())
    return Ring(model, truth, float(fit.scale))
