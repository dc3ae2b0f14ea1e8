"""Binary images of round dots, as pins."""

import numpy as np


def make_lattice(step, size=128):
    """Make centres (N, 2) px on a square lattice."""
    across = np.arange(size * 0.25, size * 0.75, step)
    return np.stack(np.meshgrid(across, across), -1).reshape(-1, 2)


def draw_dots(centres, radius, size=128):
    """Draw an image (size, size) uint8 of round dots at (N, 2) px as (column, row)."""
    rows, columns = np.indices((size, size))
    away = np.hypot(columns - centres[:, 0, None, None], rows - centres[:, 1, None, None])
    return ((away <= radius).any(0) * 255).astype(np.uint8)


def press(rest, share=0.1):
    """Move pins (P, 2) px outwards about the middle by a share, as a shape that is touched does."""
    offset = rest - rest.mean(axis=0)
    return rest + share * offset * np.exp(-np.square(offset).sum(-1, keepdims=True) / 600)
