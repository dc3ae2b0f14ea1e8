"""What labels alone can predict of the pins: a regression from pose and slide, never asked about a contact that it learnt from.

What is left over is what no simulator of the labelled motion can explain: the robot's errors, the camera's pixels, and for few
contacts what the regression has not learnt yet, so that more contacts raise it.
"""

import numpy as np

from jaxunshear.calibration.labels import Motions
from jaxunshear.calibration.statistics import less_mean

FOLDS = 5
WIDTHS = (1.0, 1.5, 2.2, 3.3, 5.0)  # of the kernel, in standard deviations of the features
RIDGES = (1e-4, 1e-3, 1e-2, 1e-1)


def features(contacts: Motions) -> np.ndarray:
    """(N, F) of labelled contacts as the sensor feels them, each column of unit spread: place and depth, heading, tilt, slide and turn."""
    count, yaw = len(contacts), contacts.yaw
    cos, sin = np.cos(yaw), np.sin(yaw)
    end, slide = contacts.tip[:, 1], contacts.tip[:, 1] - contacts.tip[:, 0]
    own = np.stack([cos * slide[:, 0] + sin * slide[:, 1], cos * slide[:, 1] - sin * slide[:, 0], slide[:, 2]], -1)
    turn = contacts.turn
    axis = turn[count:].inv().apply([0, 0, 1.0])  # the object's normal in the sensor's frame
    twist = (turn[:count].inv() * turn[count:]).as_rotvec()
    place = end[:, [0, 2]] if contacts.across else end[:, [2]]
    columns = np.column_stack([place, cos, sin, axis[:, :2], own, twist])
    spread = columns.std(axis=0)
    varied = spread > 1e-6
    return (columns[:, varied] - columns[:, varied].mean(axis=0)) / spread[varied]


def explained_by_labels(contacts: Motions, motion: np.ndarray) -> np.ndarray:
    """(N, P, 2) of motions (N, P, 2) px, each from the labels of contacts of other folds: kernel ridge regression, with the width and
    the ridge that do best over all folds."""
    x, y = features(contacts), np.nan_to_num(less_mean(motion)).reshape(len(motion), -1)
    square = np.maximum(np.sum(x**2, 1)[:, None] + np.sum(x**2, 1) - 2 * x @ x.T, 0)
    fold = np.random.default_rng(0).permutation(len(x)) % FOLDS
    best, error = np.zeros_like(y), np.inf
    for width in WIDTHS:
        kernel = np.exp(-square / (2 * width**2 * x.shape[1]))
        for ridge in RIDGES:
            predicted = np.zeros_like(y)
            for k in range(min(FOLDS, len(x))):
                here, others = fold == k, fold != k
                inner = kernel[np.ix_(others, others)] + ridge * np.eye(others.sum())
                predicted[here] = kernel[np.ix_(here, others)] @ np.linalg.solve(inner, y[others])
            off = np.sum((predicted - y) ** 2)
            if off < error:
                best, error = predicted, off
    return best.reshape(motion.shape)
