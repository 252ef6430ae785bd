"""Optimisation: robust losses and bundle adjustment."""

from epipole.optim.bundle_adjustment import BundleConfig as BundleConfig
from epipole.optim.bundle_adjustment import BundleProblem as BundleProblem
from epipole.optim.bundle_adjustment import BundleResult as BundleResult
from epipole.optim.bundle_adjustment import adjust_bundle as adjust_bundle
from epipole.optim.bundle_adjustment import free_params_mask as free_params_mask
from epipole.optim.bundle_adjustment import with_fixed_gauge as with_fixed_gauge
from epipole.optim.losses import Loss as Loss
from epipole.optim.losses import evaluate_loss as evaluate_loss
