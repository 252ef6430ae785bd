"""Lines on a viser server, each with a switch."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import viser

from epipole.scene import Curve

_THICKNESS_PX = 3.0


def add_curves(server: viser.ViserServer, curves: Sequence[Curve]) -> None:
    """Show lines, and a folder with a switch for each."""
    with server.gui.add_folder("Lines"):
        for k, curve in enumerate(curves):
            handle = server.scene.add_line_segments(
                f"/curves/{k}",
                curve.segments_in_world.astype(np.float32),
                curve.rgb,
                thickness=_THICKNESS_PX,
                thickness_units="screen",
                visible=curve.is_shown,
            )
            box = server.gui.add_checkbox(curve.name.capitalize(), curve.is_shown)
            box.on_update(_switch(handle, box))


def _switch(
    handle: viser.LineSegmentsHandle, box: viser.GuiCheckboxHandle
) -> Callable[[viser.GuiEvent[viser.GuiCheckboxHandle]], None]:
    def follow(_: viser.GuiEvent[viser.GuiCheckboxHandle]) -> None:
        handle.visible = box.value

    return follow
