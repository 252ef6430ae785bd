"""A reconstruction on a viser server: its points and cameras, and the controls."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

import numpy as np
import viser

from epipole.geometry import Rigid3, Rotation3
from epipole.image import downscaled
from epipole.scene import Curve, Reconstruction, extent_of, frustum_size
from epipole.viewer.curves import add_curves
from epipole.viewer.selection import PICTURE_SIDE_PX, LoadImage, glide, vertical_fov_rad, visible_points
from epipole.viewer.server import close_server

_RADIUS_PERCENT = 90.0
_FRUSTUM_SIZES = (0.01, 0.08)  # of the radius
_FROM_A_CORNER, _FROM_BEHIND = np.array([-1.2, -1.2, 0.9]), np.array([-0.2, -1.8, 1.0])
"""Where the first view stands; a path begins along +y."""
_FLIGHT_SECONDS, _FLIGHT_STEPS = 0.8, 40
_CAMERA_RGB, _CHOSEN_RGB = (60, 130, 160), (240, 170, 40)


class ModelViewer:
    """Points and cameras on a server with its controls, which the callbacks change."""

    def __init__(
        self, server: viser.ViserServer, reconstruction: Reconstruction, curves: Sequence[Curve] = ()
    ) -> None:
        self.server, self.reconstruction = server, reconstruction
        self.images = np.flatnonzero(reconstruction.is_registered())
        centers = reconstruction.camera_centers_in_world()[self.images]
        self.extent = extent_of(reconstruction.points.xyz_in_world, centers, _RADIUS_PERCENT)
        self.frustum_size = frustum_size(centers, *(share * self.extent.radius for share in _FRUSTUM_SIZES))
        self.world_from_cams = reconstruction.cams_from_world()[self.images].inverse()
        self.track_length = np.diff(reconstruction.tracks.offsets)
        self.stopped = threading.Event()
        self.loader: threading.Thread | None = None
        self.chosen: viser.CameraFrustumHandle | None = None
        self._set_first_view(_FROM_BEHIND if curves else _FROM_A_CORNER)
        self._add_controls()
        self._add_points()
        self._add_cameras()
        if curves:
            add_curves(server, curves)

    def _set_first_view(self, direction: np.ndarray) -> None:
        extent, camera = self.extent, self.server.initial_camera
        self.server.scene.set_up_direction("+z")
        camera.position = extent.focus + extent.radius * direction
        camera.look_at = extent.focus
        camera.near, camera.far = 1e-3 * extent.radius, 1e3 * extent.radius

    def _add_controls(self) -> None:
        gui, points = self.server.gui, self.reconstruction.points
        # The share button would send the scene through a server elsewhere.
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=_CAMERA_RGB)
        errors = points.error_px[np.isfinite(points.error_px)]
        worst = float(np.ceil(10.0 * errors.max(initial=0.1)) / 10.0)
        longest = int(max(self.track_length.max(initial=3), 3))
        self.counts = gui.add_markdown("")
        self.picture = gui.add_text("Picture", "click a camera", disabled=True)
        with gui.add_folder("Points"):
            self.point_size = gui.add_slider("Size", 0.1, 5.0, 0.1, 1.0)
            self.max_error = gui.add_slider("Error up to (px)", 0.1, worst, 0.05, worst)
            self.min_track = gui.add_slider("Seen by at least", 2, longest, 1, 2)
        with gui.add_folder("Cameras"):
            self.show_cameras = gui.add_checkbox("Show", True)
            self.frustum_scale = gui.add_slider("Size", 0.1, 5.0, 0.1, 1.0)
        self.point_size.on_update(lambda _: self._resize_points())
        self.max_error.on_update(lambda _: self._choose_points())
        self.min_track.on_update(lambda _: self._choose_points())
        self.show_cameras.on_update(lambda _: self._show_cameras())
        self.frustum_scale.on_update(lambda _: self._show_cameras())

    def _add_points(self) -> None:
        self.cloud = self.server.scene.add_point_cloud(
            "/points",
            np.zeros((0, 3), np.float32),
            np.zeros((0, 3), np.uint8),
            point_size=self._point_size(),
            point_shape="rounded",
            precision="float32",
        )
        self._choose_points()

    def _point_size(self) -> float:
        return 0.003 * self.extent.radius * self.point_size.value

    def _resize_points(self) -> None:
        self.cloud.point_size = self._point_size()

    def _choose_points(self) -> None:
        points = self.reconstruction.points
        mask = visible_points(points.error_px, self.track_length, self.max_error.value, self.min_track.value)
        with self.server.atomic():
            self.cloud.points = points.xyz_in_world[mask].astype(np.float32)
            self.cloud.colors = points.rgb[mask]
        self.counts.content = (
            f"**{len(self.images)}** of {len(self.reconstruction.images)} pictures placed  \n"
            f"**{int(mask.sum()):,}** of {len(mask):,} points shown"
        )

    def _add_cameras(self) -> None:
        quats_wxyz = Rotation3(self.world_from_cams.rotation).as_quat_wxyz()
        camera_of_image = self.reconstruction.camera_of_image
        self.frusta = []
        for row, image in enumerate(self.images):
            camera = self.reconstruction.cameras[int(camera_of_image[image])]
            frustum = self.server.scene.add_camera_frustum(
                f"/cameras/{image}",
                fov=vertical_fov_rad(camera),
                aspect=camera.width / camera.height,
                scale=self.frustum_size,
                thickness=1.5,
                thickness_units="screen",
                color=_CAMERA_RGB,
                wxyz=quats_wxyz[row],
                position=self.world_from_cams.translation[row],
            )
            frustum.on_click(self._flight_to(row))
            self.frusta.append(frustum)

    def _show_cameras(self) -> None:
        with self.server.atomic():
            for frustum in self.frusta:
                frustum.visible = self.show_cameras.value
                frustum.scale = self.frustum_size * self.frustum_scale.value

    def _flight_to(self, row: int) -> Callable[[viser.SceneNodePointerEvent], None]:
        return lambda event: self._fly(event.client, row)

    def _fly(self, client: viser.ClientHandle, row: int) -> None:
        """Move this client's view to just behind the camera, and name the picture."""
        self._choose(row)
        start = Rotation3.from_quat_wxyz(client.camera.wxyz)
        world_from_view = Rigid3(start.matrix, np.asarray(client.camera.position, float))
        setback = Rigid3(np.eye(3), np.array([0.0, 0.0, -1.2 * self.frustum_size * self.frustum_scale.value]))
        path = glide(world_from_view, self.world_from_cams[row] @ setback, _FLIGHT_STEPS)
        for quat_wxyz, position in zip(Rotation3(path.rotation).as_quat_wxyz(), path.translation):
            with client.atomic():
                client.camera.position = position
                client.camera.wxyz = quat_wxyz
            client.flush()
            time.sleep(_FLIGHT_SECONDS / _FLIGHT_STEPS)
        # From here on the mouse turns the view about the scene in front of the camera.
        reach = float(path.rotation[-1, :, 2] @ (self.extent.focus - path.translation[-1]))
        client.camera.look_at = (
            path.translation[-1] + max(reach, 0.1 * self.extent.radius) * path.rotation[-1, :, 2]
        )

    def _choose(self, row: int) -> None:
        if self.chosen is not None:
            self.chosen.color = _CAMERA_RGB
        self.chosen = self.frusta[row]
        self.chosen.color = _CHOSEN_RGB
        self.picture.value = self.reconstruction.images.name[self.images[row]]  # type: ignore[misc]

    def start_loading(self, load_image: LoadImage) -> None:
        """Put the pictures into the frusta, one after another, in a thread of its own."""

        def load_all() -> None:
            for row, image in enumerate(self.images):
                if self.stopped.is_set():
                    return
                picture = load_image(self.reconstruction.images.name[image])
                if picture is not None:
                    self.frusta[row].image = downscaled(picture, PICTURE_SIDE_PX)

        self.loader = threading.Thread(target=load_all, name="epipole-viewer-pictures", daemon=True)
        self.loader.start()

    def stop(self) -> None:
        """Close the server; a second call does nothing."""
        if self.stopped.is_set():
            return
        self.stopped.set()
        if self.loader is not None:
            self.loader.join(timeout=10.0)
        close_server(self.server)
