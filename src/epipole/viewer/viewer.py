"""A reconstruction, the depth of a pair, or Gaussians, in the browser."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from epipole.scene import Curve, Reconstruction
from epipole.viewer.depth_view import DepthView
from epipole.viewer.handle import Stoppable, ViewerHandle, serve
from epipole.viewer.selection import LoadImage
from epipole.viewer.splat_view import SplatView

if TYPE_CHECKING:
    import viser


def view(
    reconstruction: Reconstruction,
    load_image: LoadImage,
    *,
    port: int | None = None,
    host: str = "127.0.0.1",
    block: bool = True,
    curves: Sequence[Curve] = (),
) -> ViewerHandle:
    """Show a reconstruction in the browser.

    Args:
        reconstruction: the model, upright (+z is up).
        load_image: gives the RGB picture of an image name, or None where there is none; called in a thread of
            its own, one picture after another, after the viewer has started.
        port: where to listen; None: 8080, or the next free port if that is in use.
        host: the address to listen on; "0.0.0.0" lets other machines in.
        block: return only when the user interrupts with Ctrl-C, and stop the viewer then.
        curves: lines to show with it, each under a switch of its own.

    Returns:
        The address to open, and the way to stop.

    Raises:
        ConfigError: the port is in use or out of range, or the host is no address of this machine.
    """
    # viser is slow to import, and few runs end in a viewer.
    from epipole.viewer.model_viewer import ModelViewer
    from epipole.viewer.server import note_on_port, open_server

    server = open_server(host, port)
    viewer = ModelViewer(server, reconstruction, curves)
    viewer.start_loading(load_image)
    shown = server.get_port()
    return serve(viewer, shown, host, note_on_port(port, shown), block=block)


def view_depth(
    view: DepthView, *, port: int | None = None, host: str = "127.0.0.1", block: bool = True
) -> ViewerHandle:
    """Show the depth of a pair in the browser.

    Args:
        view: what is shown.
        port: where to listen; None: 8080, or the next free port if that is in use.
        host: the address to listen on.
        block: return only when the user interrupts with Ctrl-C, and stop the viewer then.

    Raises:
        ConfigError: the port is in use or out of range, or the host is no address of this machine.
    """
    # viser is slow to import, and few runs end in a viewer.
    from epipole.viewer.depth_viewer import DepthViewer

    return _shown(lambda server: DepthViewer(server, view), port, host, block=block)


def view_splats(
    view: SplatView, *, port: int | None = None, host: str = "127.0.0.1", block: bool = True
) -> ViewerHandle:
    """Show Gaussians in the browser.

    Args:
        view: what is shown.
        port: where to listen; None: 8080, or the next free port if that is in use.
        host: the address to listen on.
        block: return only when the user interrupts with Ctrl-C, and stop the viewer then.

    Raises:
        ConfigError: the port is in use or out of range, or the host is no address of this machine.
    """
    # viser is slow to import, and few runs end in a viewer.
    from epipole.viewer.splat_viewer import SplatViewer

    return _shown(lambda server: SplatViewer(server, view), port, host, block=block)


def _shown(
    viewer_on: Callable[[viser.ViserServer], Stoppable], port: int | None, host: str, *, block: bool
) -> ViewerHandle:
    """A viewer on a server of its own."""
    from epipole.viewer.server import note_on_port, open_server

    server = open_server(host, port)
    shown = server.get_port()
    return serve(viewer_on(server), shown, host, note_on_port(port, shown), block=block)
