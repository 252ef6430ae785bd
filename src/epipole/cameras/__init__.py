"""Camera models: projection and unprojection with analytic Jacobians."""

from epipole.cameras.camera import Camera as Camera
from epipole.cameras.models import MAX_PARAMS as MAX_PARAMS
from epipole.cameras.models import CameraModel as CameraModel
from epipole.cameras.models import as_camera_model as as_camera_model
from epipole.cameras.models import camera_model_named as camera_model_named
