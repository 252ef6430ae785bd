"""The viewer: one page with a 3D view, of finished scenes and of jobs that run, from a small server."""

from epipole.viewer.handle import ViewerHandle as ViewerHandle
from epipole.viewer.viewer import view_scene as view_scene
