"""Immutable data: cameras, rigs, frames, images, points, tracks, reconstructions, view graphs, depth maps, clouds, curves."""

from epipole.scene.camera_rig import CameraRig as CameraRig
from epipole.scene.cameras import Cameras as Cameras
from epipole.scene.curve import Curve as Curve
from epipole.scene.curve import path_segments as path_segments
from epipole.scene.depth_maps import DepthMap as DepthMap
from epipole.scene.depth_maps import DisparityMap as DisparityMap
from epipole.scene.depth_maps import StereoReason as StereoReason
from epipole.scene.extent import Extent as Extent
from epipole.scene.extent import extent_of as extent_of
from epipole.scene.extent import frustum_corners_in_cam as frustum_corners_in_cam
from epipole.scene.extent import frustum_size as frustum_size
from epipole.scene.frames import Frames as Frames
from epipole.scene.frames import Rigs as Rigs
from epipole.scene.frames import unregistered as unregistered
from epipole.scene.georeference import Georeference as Georeference
from epipole.scene.images import Images as Images
from epipole.scene.mesh import Mesh as Mesh
from epipole.scene.point_cloud import PointCloud as PointCloud
from epipole.scene.point_cloud import depth_map_to_point_cloud as depth_map_to_point_cloud
from epipole.scene.points import Points as Points
from epipole.scene.points import Tracks as Tracks
from epipole.scene.reconstruction import Reconstruction as Reconstruction
from epipole.scene.rectified_rig import RectifiedRig as RectifiedRig
from epipole.scene.stereo_rig import StereoRig as StereoRig
from epipole.scene.trajectory import Trajectory as Trajectory
from epipole.scene.view_graph import ViewGraph as ViewGraph
