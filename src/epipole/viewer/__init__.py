"""The viewer: a reconstruction, the depth of a stereo pair, or Gaussians, in the browser."""

from epipole.viewer.depth_view import DepthView as DepthView
from epipole.viewer.handle import ViewerHandle as ViewerHandle
from epipole.viewer.splat_view import SplatView as SplatView
from epipole.viewer.viewer import view as view
from epipole.viewer.viewer import view_depth as view_depth
from epipole.viewer.viewer import view_splats as view_splats
