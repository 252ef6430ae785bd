"""The viewer: a page with a 3D view of a finished scene or a running job, served locally."""

from epipole.viewer.handle import ViewerHandle as ViewerHandle
from epipole.viewer.viewer import view_scene as view_scene
