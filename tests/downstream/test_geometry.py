"""Heights from pins: Voronoi cells, and the inverse of the skin."""

from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.sensor import TACTIP_127, TACTIP_331
from jaxunshear.downstream.geometry import (
    INVERSE,
    MIN_INDENTATION_MM,
    compute_cell_areas,
    compute_relative_growth,
    estimate_indentation,
    fit_inverse,
    interpolate_heights,
    interpolate_surface,
)
from jaxunshear.downstream.geometry_scores import compute_correlation, estimate_recorded_heights
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.perception.drawing import draw_dots
from jaxunshear.perception.lattice import compute_rings, make_lattice
from jaxunshear.simulator.pin_layout import compute_pin_lattice


def draw_lattice(sensor, rim=46.0, middle=64.0):
    flat = compute_pin_lattice(sensor)
    flat = flat / np.linalg.norm(flat, axis=1).max()
    return make_lattice(flat * rim + middle, compute_rings(sensor))


@pytest.fixture(params=[TACTIP_331, TACTIP_127], ids=lambda sensor: sensor.layout)
def lattice(request):
    return draw_lattice(request.param)


def test_recordings_that_are_not_understood_have_no_heights(tmp_path):
    """Reject noise, of which networks over images draw pins, too."""
    untouched = draw_lattice(TACTIP_127, 48, 63.5)
    pins = np.asarray(draw_dots(np.float32(untouched.rest)[None], 2.0, 128))[0, ..., 0]
    noise = np.random.default_rng(0).random((128, 128)) < 0.2
    for name, image in (("a", pins > 0.5), ("b", noise)):  # a folder each: crops are common to one
        (tmp_path / name).mkdir()
        Image.fromarray(np.uint8(255 * image)).save(tmp_path / name / "0.png")
    networks = {"disentangled": lambda images: np.zeros((len(images), *untouched.rest.shape))}
    model = TrainedModel(tmp_path, Experiment("small", "none"))
    model.lattice = untouched
    result = SimpleNamespace(networks=networks, methods={INVERSE: lambda motion: motion[..., 0]})
    names, heights = estimate_recorded_heights(tmp_path, model, result)
    assert names == ["a/0.png", "b/0.png"] and heights.keys() == {"as recorded", "disentangled"}
    for height in heights.values():
        assert np.abs(height[0]).max() < 0.5 and np.isnan(height[1]).all()


def test_an_undeformed_sensor_is_flat_wherever_it_is(lattice):
    assert (compute_relative_growth(lattice, np.zeros_like(lattice.rest)) == 0).all()
    shift = np.full_like(lattice.rest, 3.3)
    np.testing.assert_allclose(compute_relative_growth(lattice, shift), 0, atol=1e-9)


def test_uniform_stretch_grows_inner_cells_by_its_square(lattice):
    growth = compute_relative_growth(lattice, 0.1 * (lattice.rest - lattice.centre))
    inner = lattice.ring < lattice.ring.max()
    np.testing.assert_allclose(growth[inner], 1.1**2 - 1, rtol=1e-6)
    assert (growth[~inner] > 0).all()


def test_hexagons_have_their_closed_form():
    flat = compute_pin_lattice(TACTIP_127)
    lattice = make_lattice(flat, compute_rings(TACTIP_127))
    areas = compute_cell_areas(lattice, np.zeros_like(flat))[lattice.ring < lattice.ring.max()]
    np.testing.assert_allclose(areas, np.sqrt(3) / 2 * TACTIP_127.pin_spacing_mm**2, rtol=1e-9)


def test_heights_rise_where_pins_are_drawn_apart(lattice):
    offset = lattice.rest - lattice.centre
    bell = np.exp(-np.sum(offset**2, axis=-1) / (2 * 12.0**2))
    growth = compute_relative_growth(lattice, 0.2 * offset * bell[:, None])
    assert compute_correlation(growth[None], bell[None])[0] > 0.8
    assert np.argmax(growth) < 7  # pin 0 is the middle, 1 to 6 around it


def test_missing_pins_follow_their_neighbours(lattice):
    motion = 0.05 * (lattice.rest - lattice.centre)
    with_gaps = motion.copy()
    with_gaps[[3, 40, 90]] = np.nan
    found, expected = (compute_relative_growth(lattice, each) for each in (with_gaps, motion))
    np.testing.assert_allclose(found, expected, atol=0.03)


def test_surface_passes_through_its_pins_and_is_smooth(lattice):
    x, y = (lattice.rest - lattice.centre).T / 40
    heights = 1 + x - 0.5 * y
    drawn = interpolate_surface(lattice.rest, heights, 41)
    assert drawn.shape == (41, 41) and np.isnan(drawn[0, 0])
    low, high = lattice.rest.min(axis=0), lattice.rest.max(axis=0)
    gx, gy = np.meshgrid(*(np.linspace(low[i], high[i], 41) for i in (0, 1)))
    plane = 1 + (gx - lattice.centre[0]) / 40 - 0.5 * (gy - lattice.centre[1]) / 40
    inside = ~np.isnan(drawn)
    np.testing.assert_allclose(drawn[inside], plane[inside], atol=1e-6)


def test_correlation_knows_its_extremes():
    a = np.array([[1.0, 2, 3], [1, 2, 3], [5, 5, 5]])
    b = np.array([[2.0, 4, 6], [3, 2, 1], [1, 2, 3]])
    np.testing.assert_allclose(compute_correlation(a, b), [1, -1, 0])


def test_a_shift_of_all_pins_shows_where_they_are(lattice):
    """Move all pins by half a spacing: a camera sees the same heights elsewhere."""
    x = (lattice.rest - lattice.centre)[:, 0]
    shift = np.array([0.5 * lattice.spacing, 0.0])
    heights = x / lattice.spacing
    inner = lattice.ring < lattice.ring.max() - 1
    still = interpolate_heights(lattice.rest, heights, lattice.rest)
    moved = interpolate_heights(lattice.rest + shift, heights, lattice.rest)
    np.testing.assert_allclose(still, heights, atol=1e-6)
    np.testing.assert_allclose(moved[inner], heights[inner] - 0.5, atol=1e-3)


def test_beyond_the_rim_the_nearest_height_counts(lattice):
    both = np.stack([lattice.rest[:, 0], lattice.ring.astype(float)], -1)
    far = lattice.centre + np.array([[1e3, 0.0]])
    beyond = interpolate_heights(lattice.rest, both, far)
    nearest = np.argmin(np.linalg.norm(lattice.rest - far, axis=-1))
    np.testing.assert_array_equal(beyond[0], both[nearest])


def test_a_linear_skin_is_learnt(lattice):
    generator, pins = np.random.default_rng(0), len(lattice.rest)
    shapes = generator.normal(size=(6, 2 * pins))
    rises = generator.normal(size=(6, pins))
    share = generator.normal(size=(200, 6))
    motion, heights = share @ shapes, share @ rises
    inverse = fit_inverse(lattice, motion[:150].reshape(150, pins, 2), heights[:150])
    np.testing.assert_allclose(motion[150:] @ inverse, heights[150:], atol=0.02)


def test_what_is_not_felt_is_exactly_zero_and_what_is_unknown_stays_so(lattice):
    pins = len(lattice.rest)
    first = np.zeros((2 * pins, pins))
    first[0] = 1.0
    motion = np.zeros((4, pins, 2))
    motion[:, 0, 0] = 0.9 * MIN_INDENTATION_MM, 1.1 * MIN_INDENTATION_MM, np.nan, 0.0
    indentation = estimate_indentation(first, motion)
    assert (indentation[[0, 3]] == 0).all() and np.isnan(indentation[2]).all()
    assert np.allclose(indentation[1], 1.1 * MIN_INDENTATION_MM)
