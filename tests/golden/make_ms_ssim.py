"""Golden values of MS-SSIM and SSIM from an independent library. In an environment of its own:

pip install torch==2.13.0 pytorch-msssim numpy && python tests/golden/make_ms_ssim.py

writes ms_ssim.json and ms_ssim_random.json beside this file. The images are formulas, so that only their scores are kept.
"""

import json
from pathlib import Path

import numpy as np


def dots(
    size: int, shift: tuple[float, float] = (0.0, 0.0), radius: float = 0.012, sharp: bool = True
) -> np.ndarray:
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
    noise = (
        (np.sin(np.arange(size * size) * 12.9898) * 43758.5453 % 1)
        .reshape(size, size)
        .astype(np.float32)
    )
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


def random_pairs(count: int = 100, size: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """(count, size, size) float32 each, in turn: noise and other noise, noise over the same noise, random dots that move, soft
    dots that move. The bits are PCG64's own, which no version of numpy may change."""
    sides = []
    for number in range(count):
        noise, other = (
            (np.random.PCG64(2 * number + k).random_raw(size * size) >> 11) * 2.0**-53
            for k in (0, 1)
        )
        noise, other = noise.reshape(size, size), other.reshape(size, size)
        share = (number // 4 + 1) / 26
        if number % 4 == 0:
            a, b = noise, other
        elif number % 4 == 1:
            a, b = noise, (1 - share) * noise + share * other
        else:
            # dots where noise is near its top, grown by a few pixels; the second image has some of them moved
            moved = np.where(
                soft(other, 8) < np.quantile(soft(other, 8), share), np.roll(noise, 3, 1), noise
            )
            a, b = (soft(np.where(field > 0.985, 1.0, 0.0), 3) > 0.045 for field in (noise, moved))
            if number % 4 == 3:
                a, b = soft(a.astype(float), 2), soft(b.astype(float), 1 + number // 20)
        sides.append((a, b))
    first, second = (np.stack([pair[side] for pair in sides]).astype(np.float32) for side in (0, 1))
    return first, second


def soft(image: np.ndarray, times: int) -> np.ndarray:
    """`times` means over 3x3 pixels, around the edges and on at the other side."""
    for _ in range(times):
        for axis in (0, 1):
            image = (np.roll(image, 1, axis) + image + np.roll(image, -1, axis)) / 3
    return image


def main() -> None:
    import torch
    from pytorch_msssim import ms_ssim, ssim

    def scores(a: np.ndarray, b: np.ndarray) -> dict[str, float]:
        pair = [torch.from_numpy(np.ascontiguousarray(image))[None, None] for image in (a, b)]
        return {
            "ms_ssim": float(ms_ssim(*pair, data_range=1, size_average=False)[0]),
            "ssim": float(ssim(*pair, data_range=1, size_average=False)[0]),
        }

    here = Path(__file__)
    golden = {name: scores(*pair) for name, pair in pairs().items()}
    here.with_name("ms_ssim.json").write_text(json.dumps(golden, indent=2) + "\n")
    found = [scores(a, b) for a, b in zip(*random_pairs(), strict=True)]
    columns = {name: [round(line[name], 7) for line in found] for name in ("ms_ssim", "ssim")}
    here.with_name("ms_ssim_random.json").write_text(json.dumps(columns) + "\n")


if __name__ == "__main__":
    main()
