"""Measures of images, pins and poses, by pure functions of arrays."""

from jaxunshear.metrics.errors import compute_pose_errors
from jaxunshear.metrics.images import count_scales, format_ms_ssim_name, ms_ssim, mse, ssim

__all__ = ["compute_pose_errors", "count_scales", "format_ms_ssim_name", "ms_ssim", "mse", "ssim"]
