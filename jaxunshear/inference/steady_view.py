"""The crop and the whites that a camera's frames have in common, as these come one by one."""

from collections.abc import Callable

import numpy as np

from jaxunshear.config.sensor import Preprocess
from jaxunshear.data.recordings import PROBES
from jaxunshear.perception.preprocess import View, combine_views, find_view


def make_steady_view(preprocess: Preprocess) -> Callable[[np.ndarray], View]:
    """Make a function from a camera's frames, one by one, to the view that they have in common.

    It is that of the first PROBES usable frames of each size, as far as they have come.
    """
    views: dict[tuple[int, ...], list[View]] = {}
    common: dict[tuple[int, ...], View] = {}

    def update_view(raw: np.ndarray) -> View:
        views_of_size = views.setdefault(raw.shape, [])
        if len(views_of_size) < PROBES:
            views_of_size.append(find_view(preprocess, raw))
            common[raw.shape] = combine_views(views_of_size)
        return common[raw.shape]

    return update_view
