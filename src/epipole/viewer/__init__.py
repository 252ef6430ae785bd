"""The viewer: a reconstruction in the browser, with its pictures."""

from epipole.viewer.viewer import ViewerHandle as ViewerHandle
from epipole.viewer.viewer import view as view
