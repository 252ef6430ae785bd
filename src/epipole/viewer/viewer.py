"""Showing a finished scene in the browser."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from epipole.report.space import small_jpeg
from epipole.report.space_scene import SpaceScene
from epipole.viewer.handle import ViewerHandle, serve
from epipole.viewer.page_server import BYTES, HTML, JPEG, PageServer, Request, Served, fixed
from epipole.viewer.ports import note_on_port, port_for
from epipole.viewer.scene_page import DEPTH_ADDRESS, IMAGE_ADDRESS, served_page


def view_scene(
    scene: SpaceScene, *, port: int | None = None, host: str = "127.0.0.1", block: bool = True
) -> ViewerHandle:
    """Show a scene in the browser.

    Args:
        scene: the scene; its cameras' images are loaded when viewed.
        port: the port to listen on; None: 8080, or the next free port if that is in use.
        host: the address to listen on; "0.0.0.0" allows connections from other machines.
        block: return only after Ctrl-C, which also stops the viewer.

    Returns:
        The address to open, and a function to stop the viewer.

    Raises:
        ConfigError: the port is in use or out of range, or the host is not an address of this machine.
    """
    chosen = port_for(host, port)
    server = PageServer(scene_pages(scene)[0], host, chosen)
    return serve(server, server.port, host, note_on_port(port, server.port), block=block)


def scene_pages(
    scene: SpaceScene, live: dict[str, Any] | None = None
) -> tuple[dict[str, Served], np.ndarray]:
    """The page of a scene and its data by address, and the origin of its coordinates.

    Args:
        scene: the scene.
        live: settings for the script of a live page; None: the scene is finished.
    """
    html, data = served_page(scene, live)
    pages = {"": fixed(HTML, html.encode("utf-8"))}
    pages |= {f"data/{name}": fixed(BYTES, block_) for name, block_ in data.blocks.items()}
    cameras = scene.cameras
    if cameras is not None:
        for address, load in ((IMAGE_ADDRESS, cameras.load_image), (DEPTH_ADDRESS, cameras.load_depth)):
            if load is not None:
                for k, name in enumerate(cameras.names):
                    pages[f"{address}{k}"] = Served(JPEG, partial(_image, partial(small_jpeg, load, name)))
    return pages, np.array(data.numbers["origin"], np.float64)


def _image(make: Callable[[], bytes | None], _: Request) -> bytes | None:
    return make()
