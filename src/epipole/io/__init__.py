"""Files that people already use (COLMAP, nerfstudio, Bundler, PLY), known cameras, and atomic writing."""

from epipole.io.atomic import atomic_folder as atomic_folder
from epipole.io.atomic import atomic_write as atomic_write
from epipole.io.bal import read_bal as read_bal
from epipole.io.bal import write_bal as write_bal
from epipole.io.bundler import write_bundler as write_bundler
from epipole.io.colmap import params_from_colmap as params_from_colmap
from epipole.io.colmap import params_to_colmap as params_to_colmap
from epipole.io.colmap import read_colmap_model as read_colmap_model
from epipole.io.colmap import write_colmap_model as write_colmap_model
from epipole.io.colmap_database import DatabaseContents as DatabaseContents
from epipole.io.colmap_database import read_database as read_database
from epipole.io.colmap_database import write_database as write_database
from epipole.io.convert import ModelFormat as ModelFormat
from epipole.io.convert import read_model as read_model
from epipole.io.g2o import G2oFile as G2oFile
from epipole.io.g2o import read_g2o as read_g2o
from epipole.io.g2o import write_g2o as write_g2o
from epipole.io.ply import PlyPoints as PlyPoints
from epipole.io.ply import read_points_ply as read_points_ply
from epipole.io.ply import write_points_ply as write_points_ply
from epipole.io.ply import write_scene_ply as write_scene_ply
from epipole.io.transforms_json import read_transforms as read_transforms
from epipole.io.transforms_json import write_transforms as write_transforms
from epipole.io.truth import TruthCameras as TruthCameras
from epipole.io.truth import read_truth as read_truth
