"""Frozen columns: cameras, rigs, frames, images, points, tracks, reconstruction, view graph; extent."""

from epipole.scene.cameras import Cameras as Cameras
from epipole.scene.extent import Extent as Extent
from epipole.scene.extent import extent_of as extent_of
from epipole.scene.extent import frustum_corners_in_cam as frustum_corners_in_cam
from epipole.scene.extent import frustum_size as frustum_size
from epipole.scene.frames import Frames as Frames
from epipole.scene.frames import Rigs as Rigs
from epipole.scene.frames import unregistered as unregistered
from epipole.scene.images import Images as Images
from epipole.scene.points import Points as Points
from epipole.scene.points import Tracks as Tracks
from epipole.scene.reconstruction import Reconstruction as Reconstruction
from epipole.scene.stereo_rig import StereoRig as StereoRig
from epipole.scene.view_graph import ViewGraph as ViewGraph
