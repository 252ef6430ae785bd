"""Gaussians on a viser server, with the controls."""

from __future__ import annotations

import threading

import numpy as np
import viser

from epipole.geometry import Rotation3
from epipole.scene.gaussian_cloud import DC
from epipole.viewer.server import close_server
from epipole.viewer.splat_view import SplatView


class SplatViewer:
    """Gaussians in the colours that they have from all sides; faint ones can be taken away."""

    def __init__(self, server: viser.ViserServer, view: SplatView) -> None:
        self.server, self.view = server, view
        self.stopped = threading.Event()
        self.opacities = 1.0 / (1.0 + np.exp(-view.cloud.opacity_logits.astype(np.float64)))
        self._set_first_view()
        self._add_controls()
        self.handle: viser.GaussianSplatHandle | None = None
        self._choose()

    def stop(self) -> None:
        """Close the server; again does nothing."""
        if not self.stopped.is_set():
            self.stopped.set()
            close_server(self.server)

    def _set_first_view(self) -> None:
        camera, away = self.server.initial_camera, self.view.position - self.view.look_at
        self.server.scene.set_up_direction(tuple(self.view.up.tolist()))
        camera.position, camera.look_at = self.view.position, self.view.look_at
        distance = float(np.linalg.norm(away))
        camera.near, camera.far = 1e-2 * distance, 1e3 * distance

    def _add_controls(self) -> None:
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        self.counts = gui.add_markdown("")
        self.least = gui.add_slider("Opacity from", 0.0, 0.99, 0.01, 0.0)
        self.least.on_update(lambda _: self._choose())
        gui.add_markdown(f"{self.view.unit}. Colours are those of harmonics of degree 0.")

    def _choose(self) -> None:
        shown, cloud = self.opacities >= self.least.value, self.view.cloud
        if self.handle is not None:
            self.handle.remove()
        axes = Rotation3.from_quat_wxyz(cloud.quats_wxyz[shown].astype(np.float64)).matrix
        longs = axes * np.exp(cloud.log_scales[shown])[:, None]
        self.handle = self.server.scene.add_gaussian_splats(
            "/splats",
            cloud.means_in_world[shown],
            (longs @ np.swapaxes(longs, 1, 2)).astype(np.float32),
            np.clip(0.5 + DC * cloud.sh[shown, 0], 0.0, 1.0),
            self.opacities[shown, None].astype(np.float32),
        )
        self.counts.content = f"{int(shown.sum()):,} of {len(shown):,} Gaussians"
