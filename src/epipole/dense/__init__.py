"""Dense geometry of many views: depth, clouds, meshes and textures."""

from epipole.dense.depth import view_depth as view_depth
from epipole.dense.fusion import DensePoints as DensePoints
from epipole.dense.surfaces import FusedDepths as FusedDepths
from epipole.dense.surfaces import estimate_depth as estimate_depth
from epipole.dense.surfaces import fuse_depths as fuse_depths
from epipole.dense.surfaces import mesh_depths as mesh_depths
from epipole.dense.surfaces import texture_from_images as texture_from_images
from epipole.dense.terrain import terrain_model as terrain_model
from epipole.dense.view import DenseView as DenseView
from epipole.dense.volume import SparseVolume as SparseVolume
