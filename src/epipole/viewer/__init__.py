"""The viewer: a reconstruction in the browser, with its pictures."""

from epipole.viewer.depth_view import DepthView as DepthView
from epipole.viewer.handle import ViewerHandle as ViewerHandle
from epipole.viewer.viewer import view as view
from epipole.viewer.viewer import view_depth as view_depth
