"""The depth of one pair on a viser server: points, the camera, and the controls."""

from __future__ import annotations

import threading

import numpy as np
import viser
from jaxtyping import Bool, UInt8

from epipole.image import color_map, downscaled
from epipole.viewer.depth_view import DepthView
from epipole.viewer.selection import PICTURE_SIDE_PX
from epipole.viewer.server import close_server

_PLAIN, _BY_DEPTH, _BY_ERROR = "picture", "depth", "error of depth"


class DepthViewer:
    """Points before the camera that saw them; less certain ones can be taken away."""

    def __init__(self, server: viser.ViserServer, view: DepthView) -> None:
        self.server, self.view = server, view
        self.stopped = threading.Event()
        self.middle = float(np.median(view.points_in_cam[:, 2]))
        self._set_first_view()
        self._add_controls()
        self._add_camera()
        self.cloud = self._add_cloud()
        self._choose()

    def stop(self) -> None:
        """Close the server; again does nothing."""
        if not self.stopped.is_set():
            self.stopped.set()
            close_server(self.server)

    def _set_first_view(self) -> None:
        camera = self.server.initial_camera
        self.server.scene.set_up_direction("-y")
        camera.position = self.middle * np.array([-0.25, -0.25, -0.2])
        camera.look_at = np.array([0.0, 0.0, self.middle])
        camera.near, camera.far = 1e-3 * self.middle, 1e3 * self.middle

    def _add_controls(self) -> None:
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        self.counts = gui.add_markdown("")
        worst = float(np.ceil(100.0 * np.quantile(self.view.relative_sigma, 0.99)))
        with gui.add_folder("Points"):
            self.size = gui.add_slider("Size", 0.1, 5.0, 0.1, 1.0)
            self.color = gui.add_dropdown("Colour", (_PLAIN, _BY_DEPTH, _BY_ERROR))
            self.most_error = gui.add_slider(
                "Error up to (% of depth)", 0.1, max(worst, 0.2), 0.1, max(worst, 0.2)
            )
        self.size.on_update(lambda _: setattr(self.cloud, "point_size", self._point_size()))
        self.color.on_update(lambda _: self._choose())
        self.most_error.on_update(lambda _: self._choose())
        with gui.add_folder("Pictures"):
            for label, picture in (("left", self.view.left_rgb), ("depth", self.view.depth_rgb)):
                gui.add_image(downscaled(picture, PICTURE_SIDE_PX), label=label)

    def _add_camera(self) -> None:
        height, width = self.view.left_rgb.shape[:2]
        self.server.scene.add_camera_frustum(
            "/camera",
            fov=float(2.0 * np.arctan(0.5 * height / self.view.focal_px)),
            aspect=width / height,
            scale=0.1 * self.middle,
            image=downscaled(self.view.left_rgb, PICTURE_SIDE_PX),
        )

    def _add_cloud(self) -> viser.PointCloudHandle:
        return self.server.scene.add_point_cloud(
            "/points",
            self.view.points_in_cam.astype(np.float32),
            self.view.point_rgb,
            point_size=self._point_size(),
            point_shape="square",
        )

    def _point_size(self) -> float:
        return float(self.size.value) * self.middle / self.view.focal_px

    def _choose(self) -> None:
        shown: Bool[np.ndarray, " n"] = self.view.relative_sigma <= self.most_error.value / 100.0
        self.cloud.points = self.view.points_in_cam[shown].astype(np.float32)
        self.cloud.colors = self._colors()[shown]
        self.counts.content = f"{int(shown.sum())} of {len(shown)} points"

    def _colors(self) -> UInt8[np.ndarray, "n 3"]:
        if self.color.value == _PLAIN:
            return self.view.point_rgb
        values = self.view.points_in_cam[:, 2] if self.color.value == _BY_DEPTH else self.view.relative_sigma
        return color_map(np.log(np.maximum(values, 1e-12)))
