"""One function per job: what the command line does, from Python."""

from __future__ import annotations

from pathlib import Path

from epipole._checks import as_path
from epipole.cameras import Camera as Camera
from epipole.cameras import CameraModel as CameraModel
from epipole.config import AnchorOptions as AnchorOptions
from epipole.config import BoardConfig as BoardConfig
from epipole.config import FeatureConfig as FeatureConfig
from epipole.config import MatchConfig as MatchConfig
from epipole.config import RansacConfig as RansacConfig
from epipole.geometry import Rigid3 as Rigid3
from epipole.pipelines.calibration.config import CalibrationConfig as CalibrationConfig
from epipole.pipelines.calibration.files import CalibrationRun as CalibrationRun
from epipole.pipelines.calibration.run import calibrate as calibrate
from epipole.pipelines.conversion.run import Conversion as Conversion
from epipole.pipelines.conversion.run import convert as convert
from epipole.pipelines.demo.run import DemoResult as DemoResult
from epipole.pipelines.demo.run import demo as demo
from epipole.pipelines.evaluation.run import Evaluation as Evaluation
from epipole.pipelines.evaluation.run import evaluate as evaluate
from epipole.pipelines.evaluation.trajectories import TrajectoryEvaluation as TrajectoryEvaluation
from epipole.pipelines.evaluation.trajectories import evaluate_trajectory as evaluate_trajectory
from epipole.pipelines.fields.config import FieldOptions as FieldOptions
from epipole.pipelines.fields.run import SplatResult as SplatResult
from epipole.pipelines.fields.run import splat as splat
from epipole.pipelines.sfm import scene as _sfm_scene
from epipole.pipelines.sfm.config import MapperConfig as MapperConfig
from epipole.pipelines.sfm.config import PairingConfig as PairingConfig
from epipole.pipelines.sfm.config import ReconstructConfig as ReconstructConfig
from epipole.pipelines.sfm.run import ReconstructionResult as ReconstructionResult
from epipole.pipelines.sfm.run import reconstruct as reconstruct
from epipole.pipelines.slam import scene as _slam_scene
from epipole.pipelines.slam.config import CameraOptions as CameraOptions
from epipole.pipelines.slam.config import JobOptions as JobOptions
from epipole.pipelines.slam.config import SlamConfig as SlamConfig
from epipole.pipelines.slam.frames import DepthCamera as DepthCamera
from epipole.pipelines.slam.frames import Frame as Frame
from epipole.pipelines.slam.frames import SlamCamera as SlamCamera
from epipole.pipelines.slam.frames import TrackedFrame as TrackedFrame
from epipole.pipelines.slam.map_files import read_slam_map as read_slam_map
from epipole.pipelines.slam.map_files import write_slam_map as write_slam_map
from epipole.pipelines.slam.results import SlamResult as SlamResult
from epipole.pipelines.slam.run import slam as slam
from epipole.pipelines.slam.slam import Slam as Slam
from epipole.pipelines.stereo import scene as _stereo_scene
from epipole.pipelines.stereo.config import StereoConfig as StereoConfig
from epipole.pipelines.stereo.doctor import Diagnosis as Diagnosis
from epipole.pipelines.stereo.pair import StereoResult as StereoResult
from epipole.pipelines.stereo.pairs import StereoBatch as StereoBatch
from epipole.pipelines.stereo.run import examine_stereo as examine_stereo
from epipole.pipelines.stereo.run import stereo as stereo
from epipole.pipelines.stereo.run import stereo_many as stereo_many
from epipole.pipelines.stereo.run import stereo_of_model as stereo_of_model
from epipole.pipelines.undistortion.run import undistort as undistort
from epipole.scene import Reconstruction as Reconstruction
from epipole.scene import RectifiedRig as RectifiedRig
from epipole.scene import StereoRig as StereoRig
from epipole.viewer import ViewerHandle as ViewerHandle


def view(
    out: str | Path, *, port: int | None = None, host: str = "127.0.0.1", block: bool = True
) -> ViewerHandle:
    """Show an output folder in the browser: a model with its pictures, a path and its map, or a pair's depth.

    Args:
        out: output folder of a job, or a COLMAP model.
        port: where to listen; None: 8080, or the next free port if that is in use, which the handle's note says.
        host: the address to listen on; "0.0.0.0" lets other machines in.
        block: return only when the user interrupts with Ctrl-C.

    Raises:
        FileFormatError: the folder holds nothing that can be shown.
        ConfigError: the port is in use or out of range, or the host is no address of this machine.
    """
    path = as_path(out)
    own = (scene for scene in (_stereo_scene, _slam_scene) if scene.is_mine(path))
    scene = next(own, _sfm_scene)
    return scene.show(path, port=port, host=host, block=block)
