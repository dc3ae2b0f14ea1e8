"""Pictures on a page of 1280 px: no text is cut off or too small to read."""

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxunshear.downstream.contour import trace_contour
from jaxunshear.downstream.object_reconstruction import ReconstructedObject
from jaxunshear.downstream.reconstruct import HeightMap, ShapeScore
from jaxunshear.downstream.servo import CLOSED
from jaxunshear.report.application_figures import (
    METHOD_TITLES,
    PICTURES,
    plot_objects,
    plot_recordings,
    plot_trajectories,
)
from jaxunshear.simulator.stimuli import STIMULI

PAGE_PX = 1158  # of a picture, at most
READ_PX = 10  # height of letters


@pytest.fixture
def drawn(monkeypatch):
    """The figures as they were saved."""
    figures, save = [], Figure.savefig

    def kept(figure, file, **settings):
        figures.append(figure)
        save(figure, file, **settings)

    monkeypatch.setattr(Figure, "savefig", kept)
    return figures


def check(figure):
    figure.canvas.draw()
    shrunk = min(1, PAGE_PX / figure.bbox.width)
    titles = [axes.title for axes in figure.axes] + ([figure._suptitle] if figure._suptitle else [])
    texts = [text for axes in figure.axes for text in axes.texts]
    for axes in figure.axes:
        texts += (*axes.get_xticklabels(), *axes.get_yticklabels()) if axes.axison else ()
    for text in titles + texts:
        assert text.get_fontsize() * figure.dpi / 72 * shrunk > READ_PX, text
    for text in titles:
        box = text.get_window_extent()
        assert 0 <= box.x0 <= box.x1 <= figure.bbox.width, text
        assert 0 <= box.y0 <= box.y1 <= figure.bbox.height, text


@pytest.mark.parametrize("count", [1, pytest.param(3, marks=pytest.mark.long), 7])
def test_objects_fit(drawn, count):
    x = np.linspace(-20, 20, 30)
    shape = np.hypot(*np.meshgrid(x, x)) < 15
    heights, score = HeightMap(x, np.where(shape, 1.0, -1.0)), ShapeScore(0.93, 0.21, 1.0, 0.9)
    solid = ReconstructedObject(heights, shape, shape.T, score, 0, 0.0, None)
    for _, text in PICTURES.values():
        plot_objects("teardrop", dict.fromkeys(list(METHOD_TITLES)[:count], solid), text)
    for figure in drawn:
        check(figure)


@pytest.mark.parametrize("count", [1, 3, 7])
def test_walks_fit(drawn, count):
    line = trace_contour(STIMULI["disk"])
    tracks = np.repeat(line.points[None], 2 * count, 0)
    way = np.repeat(list(METHOD_TITLES)[:count], 2)
    end = np.where(np.arange(2 * count) % 2, CLOSED, CLOSED + 1)
    plot_trajectories(SimpleNamespace(method=way, point=tracks, end=end), line, "disk")
    check(*drawn)


def test_heights_fit(drawn):
    place = np.stack(np.meshgrid(*[np.linspace(-9, 9, 9)] * 2), -1).reshape(-1, 2)
    height = np.exp(-np.sum(place**2, 1) / 30)[None]
    kinds = dict.fromkeys(("sheared", *list(METHOD_TITLES)[2:7]), height)
    plot_recordings(place, (["a/recording.png"], kinds))
    check(*drawn)
