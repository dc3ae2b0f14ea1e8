"""Outlines as points, counter-clockwise, by other means than the package's, and their distances."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.spatial import ConvexHull, cKDTree
from skimage.measure import points_in_poly

SPACING_MM = 0.05


def arc(x, y, radius, start, end):
    angle = np.radians(np.linspace(start, end, 4000))
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], -1)


def clover():
    """A ball of 4 mm rolls round four disks of 28 mm: it rests where it touches two of them."""
    ball = brentq(lambda m: np.hypot(m - 28, m) - 32, 28, 40)
    touch = np.degrees(np.arctan2(ball, ball - 28))
    quarter = np.concatenate(
        [arc(28, 0, 28, -touch, touch), arc(ball, ball, 4, touch - 180, -90 - touch)]
    )  # the ball's arc runs clockwise
    turns = [np.array([[0, -1], [1, 0]]), np.array([[-1, 0], [0, -1]]), np.array([[0, 1], [-1, 0]])]
    return np.concatenate([quarter, *(quarter @ turn.T for turn in turns)])


def teardrop():
    both = np.concatenate([arc(0, 0, 30, 0, 359.9), arc(45, 0, 1, 0, 359.9)])
    return both[ConvexHull(both).vertices]


def leaf():
    """A disk of 1 mm rolls round the overlap of two of 55 mm."""
    tip = np.sqrt(55**2 - 32**2)
    steep = np.degrees(np.arctan2(32, tip))
    sides = [arc(0, -32, 56, steep, 180 - steep), arc(0, 32, 56, 180 + steep, 360 - steep)]
    tips = [arc(-tip, 0, 1, 180 - steep, 180 + steep), arc(tip, 0, 1, -steep, steep)]
    return np.concatenate([sides[0], tips[0], sides[1], tips[1]])


def polar(radius, angle):
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)


def flower():
    angle = np.linspace(0, 2 * np.pi, 20001)
    return polar(38 + 7 * np.cos(5 * angle), angle)


def spiral(inner, pitch, turns, half_width):
    angle = np.linspace(0, 2 * np.pi * turns, 20001)
    spine = polar(inner + pitch * angle / (2 * np.pi), angle)
    across = normals(np.gradient(spine, angle, axis=0, edge_order=2))
    begin, end = (np.degrees(np.arctan2(*across[at, ::-1])) for at in (0, -1))
    caps = [
        arc(*spine[-1], half_width, end, end + 180),
        arc(*spine[0], half_width, begin + 180, begin + 360),
    ]
    sides = spine + half_width * across, (spine - half_width * across)[::-1]
    return np.concatenate([sides[0], caps[0], sides[1], caps[1]])


def normals(along):
    """Unit normals (N, 2) to the right of directions (N, 2)."""
    across = np.stack([along[:, 1], -along[:, 0]], -1)
    return across / np.linalg.norm(along, axis=-1, keepdims=True)


OUTLINES = {
    "disk": lambda: arc(0, 0, 50, 0, 360),
    "clover": clover,
    "teardrop": teardrop,
    "flower": flower,
    "leaf": leaf,
    "spiral_1": lambda: spiral(9, 20, 2, 5),
    "spiral_2": lambda: spiral(14, 30, 1.25, 8),
}


class Truth(NamedTuple):
    distance: np.ndarray  # (N,) mm, negative inside
    normal: np.ndarray  # (N, 2)
    clear: np.ndarray  # (N,) bool: nowhere else is the outline as near, to 2 %


def dense(corners):
    """Points (K, 2) no more than SPACING_MM apart on the closed line through corners (V, 2)."""
    corners = np.concatenate([corners, corners[:1]])
    corners = corners[np.append(True, np.linalg.norm(np.diff(corners, axis=0), axis=-1) > 1e-9)]
    way = np.append(0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=-1)))
    pieces = [
        np.linspace(begin, end, int(np.ceil((end - begin) / SPACING_MM)), endpoint=False)
        for begin, end in pairwise(way)
    ]
    along = np.concatenate(pieces)
    return np.stack([np.interp(along, way, line) for line in corners.T], -1)


def truth(line, xy):
    """Of points (N, 2) from a dense outline (K, 2)."""
    tree = cKDTree(line)
    near = tree.query(xy)[1]
    feet, flats = [], []
    for shift in (0, -1):  # the two pieces that meet at the nearest point
        begin = line[(near + shift) % len(line)]
        along = line[(near + shift + 1) % len(line)] - begin
        share = np.clip(np.sum((xy - begin) * along, -1) / np.sum(along * along, -1), 0, 1)
        feet.append(begin + share[:, None] * along)
        flats.append(normals(along))
    apart = np.linalg.norm(xy - np.stack(feet), axis=-1)
    pick = np.argmin(apart, axis=0), np.arange(len(xy))
    far, away = apart[pick], xy - np.stack(feet)[pick]
    signed = np.where(points_in_poly(xy, line), -far, far)
    is_off = far > 1e-3
    radial = away / np.where(is_off, signed, 1)[:, None]
    normal = np.where(is_off[:, None], radial, np.stack(flats)[pick])
    clear = np.ones(len(xy), bool)
    for row in np.flatnonzero(is_off):
        ways = line[tree.query_ball_point(xy[row], 1.02 * far[row])] - xy[row]
        seen = ways @ away[row] / (np.linalg.norm(ways, axis=-1) * far[row])
        clear[row] = np.all(seen < -np.cos(np.radians(40)))
    return Truth(signed, normal, clear)
