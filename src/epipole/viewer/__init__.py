"""The viewer: scenes that are finished as a page of a small server, jobs that run with viser."""

from epipole.viewer.handle import ViewerHandle as ViewerHandle
from epipole.viewer.viewer import view_scene as view_scene
