"""Measures of images, pins and poses: pure functions on arrays."""

from jaxunshear.metrics.images import ms_ssim, ms_ssim_name, mse, scales_that_fit, ssim
from jaxunshear.metrics.pose import pose_errors

__all__ = ["ms_ssim", "ms_ssim_name", "mse", "pose_errors", "scales_that_fit", "ssim"]
