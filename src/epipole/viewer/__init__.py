"""The viewer: a reconstruction, or the depth of a stereo pair, in the browser."""

from epipole.viewer.depth_view import DepthView as DepthView
from epipole.viewer.handle import ViewerHandle as ViewerHandle
from epipole.viewer.viewer import view as view
from epipole.viewer.viewer import view_depth as view_depth
