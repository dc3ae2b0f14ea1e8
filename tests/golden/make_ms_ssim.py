"""Golden values of MS-SSIM and SSIM from an independent library. In an environment of its own:

pip install torch==2.13.0 pytorch-msssim numpy && python tests/golden/make_ms_ssim.py

writes ms_ssim.json beside this file. The images are formulas, so that only their scores are kept.
"""

import json
from pathlib import Path

import numpy as np


def dots(size: int, shift: tuple[float, float] = (0.0, 0.0), radius: float = 0.012, sharp: bool = True) -> np.ndarray:
    """(size, size) float32: a lattice of dots, bent by `shift` (fractions of the size) most in the middle."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    bend = np.exp(-((x - 0.5) ** 2 + (y - 0.5) ** 2) / 0.08)
    u, v = x - shift[0] * bend, y - shift[1] * bend
    pitch = 0.045
    away = np.hypot((u + pitch / 2) % pitch - pitch / 2, (v + pitch / 2) % pitch - pitch / 2)
    image = (away < radius) if sharp else 1 / (1 + np.exp((away - radius) / 0.004))
    return (image * (np.hypot(x - 0.5, y - 0.5) < 0.45)).astype(np.float32)


def pairs(size: int = 256) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Named pairs of images: like and unlike, sharp and soft, smooth, noisy, opposite, constant."""
    tap = dots(size)
    y, x = np.mgrid[:size, :size] / size
    wave = (0.5 + 0.5 * np.sin(37 * x + 11 * y * y)).astype(np.float32)
    noise = (np.sin(np.arange(size * size) * 12.9898) * 43758.5453 % 1).reshape(size, size).astype(np.float32)
    return {
        "equal": (tap, tap),
        "shifted a little": (tap, dots(size, (0.004, 0.0))),
        "shifted by half a pitch": (tap, dots(size, (0.02, 0.01))),
        "shifted by a pitch": (tap, dots(size, (0.045, 0.0))),
        "softened": (tap, dots(size, sharp=False)),
        "dimmed": (tap, 0.6 * tap + 0.1),
        "smooth": (wave, 0.8 * wave + 0.2 * x.astype(np.float32)),
        "noisy": (tap, 0.9 * tap + 0.1 * noise),
        "noise": (noise, noise[::-1].copy()),
        "opposite": (tap, 1 - tap),
        "constants": (np.full_like(tap, 0.2), np.full_like(tap, 0.7)),
        "black and dots": (np.zeros_like(tap), tap),
    }


def main() -> None:
    import torch
    from pytorch_msssim import ms_ssim, ssim

    golden = {}
    for name, pair in pairs().items():
        a, b = (torch.from_numpy(np.ascontiguousarray(image))[None, None] for image in pair)
        golden[name] = {
            "ms_ssim": float(ms_ssim(a, b, data_range=1, size_average=False)[0]),
            "ssim": float(ssim(a, b, data_range=1, size_average=False)[0]),
        }
    path = Path(__file__).with_name("ms_ssim.json")
    path.write_text(json.dumps(golden, indent=2) + "\n")


if __name__ == "__main__":
    main()
