"""The depth of a pair in the browser: its points, the camera, and how sure each point is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8

from epipole.errors import ShapeError
from epipole.viewer.viewer import ViewerHandle, serve


@dataclass(frozen=True, slots=True, eq=False)
class DepthView:
    """What is shown."""

    points_in_cam: Float64[np.ndarray, "n 3"]
    point_rgb: UInt8[np.ndarray, "n 3"]
    relative_sigma: Float64[np.ndarray, " n"]
    """Standard deviation of each point's depth over its depth."""
    left_rgb: UInt8[np.ndarray, "h w 3"]
    depth_rgb: UInt8[np.ndarray, "h w 3"]
    """Depth in colours."""
    focal_px: float

    def __post_init__(self) -> None:
        """Check that there is something to see.

        Raises:
            ShapeError: there is no point, or the columns differ in length.
        """
        if not len(self.points_in_cam):
            raise ShapeError("there is no point to show")
        if not len(self.points_in_cam) == len(self.point_rgb) == len(self.relative_sigma):
            raise ShapeError("points, colours and errors differ in number")


def view_depth(
    view: DepthView, *, port: int = 8080, host: str = "127.0.0.1", block: bool = True
) -> ViewerHandle:
    """Show the depth of a pair in the browser.

    Args:
        view: what is shown.
        port: where to listen; the next free port is taken if this one is in use.
        host: the address to listen on.
        block: return only when the user interrupts with Ctrl-C, and stop the viewer then.
    """
    from epipole.viewer.depth_room import DepthRoom  # viser is slow to import
    from epipole.viewer.room import open_server

    server = open_server(host, port)
    return serve(DepthRoom(server, view), server.get_port(), host, block=block)
