"""Camera models: projection and unprojection with analytic Jacobians."""

from epipole.cameras.camera import Camera as Camera
from epipole.cameras.image_fit import ImagePixels as ImagePixels
from epipole.cameras.image_fit import ImageShape as ImageShape
from epipole.cameras.image_fit import camera_of_image as camera_of_image
from epipole.cameras.image_fit import described_pixels as described_pixels
from epipole.cameras.image_fit import fitted_camera as fitted_camera
from epipole.cameras.image_fit import turned_camera as turned_camera
from epipole.cameras.image_fit import turned_pixels as turned_pixels
from epipole.cameras.models import MAX_PARAMS as MAX_PARAMS
from epipole.cameras.models import CameraModel as CameraModel
from epipole.cameras.models import as_camera_model as as_camera_model
from epipole.cameras.models import camera_model_named as camera_model_named
from epipole.cameras.visibility import project_visible as project_visible
