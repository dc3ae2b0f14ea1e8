"""Measures of images, pins and poses: pure functions on arrays."""

from jaxunshear.metrics.images import ms_ssim, ms_ssim_name, mse, scales_that_fit, ssim
from jaxunshear.metrics.pose import QUANTITIES, pose_errors, true_quantities

__all__ = ["QUANTITIES", "ms_ssim", "ms_ssim_name", "mse", "pose_errors", "scales_that_fit", "ssim", "true_quantities"]
