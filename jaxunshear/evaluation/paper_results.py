"""The paper's figures, measured on a real TacTip.

Gupta, Aitchison, Lepora: Tactile Image-to-Image Disentanglement. Keys are those of our results. The
paper does not name its MS-SSIM library.
"""

from jaxunshear.config.networks import DISENTANGLED, ENTANGLED

PAPER = {
    "ms_ssim": {  # Table 1
        "sheared": {"disk": 0.33, "clover": 0.31, "teardrop": 0.33, "overall": 0.32},
        ENTANGLED: {"disk": 0.91, "clover": 0.90, "teardrop": 0.90, "overall": 0.90},
        DISENTANGLED: {"disk": 0.94, "clover": 0.92, "teardrop": 0.92, "overall": 0.93},
    },
    "pose_mae": {  # Table 2; a PoseNet trained on taps
        "tap": {"x_mm": 0.43, "yaw_deg": 2.13},
        "sheared": {"x_mm": 2.72, "yaw_deg": 22.20},
        ENTANGLED: {"x_mm": 0.95, "yaw_deg": 6.73},
        DISENTANGLED: {"x_mm": 0.64, "yaw_deg": 4.38},
    },
    "swap": {  # appendix D; its "SSIM" of 93 % is Table 1's multi-scale figure
        "DC(z_p)": {"mse": 0.023, "ms_ssim": 0.93},
        "DC(z_s)": {"mse": 0.22, "ms_ssim": 0.02},
        "DS(z_p,z_s)": {"mse": 0.002, "ms_ssim": 0.995},
        "DS(z_p,z_p)": {"mse": 0.1, "ms_ssim": 0.11},
    },
}
