"""How far the skin above the pins was pressed in: on a flat face geometry alone says."""

import numpy as np
import pytest
from jaxunshear.simulator.indentation import compute_indentation

from jaxunshear.config.sensor import TACTIP_331, get_sensor
from jaxunshear.simulator.paths import make_paths
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.scene import Scenes
from jaxunshear.simulator.simulate import follow

DEPTH = 3.0


def pressed(sensor, x):
    """At (x, 0) mm from the disk's edge; from -20 mm on its face is all that the dome feels."""
    pose = np.array([[x, 0, 0, DEPTH]])
    scene = Scenes(np.zeros(1, int), pose, np.zeros((1, 2)), np.array([0.5]))
    _, skins = follow(sensor, ("disk",), make_paths(scene))
    return compute_indentation(sensor, skins)[0]


@pytest.mark.parametrize(
    "name", ["tactip331", "tactip331-fitted"]
)  # the fitted one has pins beyond the contact nodes
def test_on_a_face_it_is_how_far_the_dome_would_reach_into_it(name):
    sensor = get_sensor(name)
    found = pressed(sensor, -20.0)
    outward = compute_pin_tips(sensor) - [0, 0, sensor.dome_radius_mm]
    angle = np.arccos(-outward[:, 2] / np.linalg.norm(outward, axis=-1))
    reach = DEPTH - sensor.dome_radius_mm * (1 - np.cos(angle))  # along the axis
    inside = reach > 0.8
    np.testing.assert_allclose(found[inside], (reach * np.cos(angle))[inside], atol=0.25)
    assert abs(found[0] - DEPTH) < 0.05
    assert np.abs(found[angle > 0.95 * angle.max()]).max() < 0.5


def test_beside_an_edge_only_one_side_is_pressed_in():
    found = pressed(TACTIP_331, 0.0)
    x = compute_pin_tips(TACTIP_331)[:, 0]
    near = np.linalg.norm(compute_pin_tips(TACTIP_331)[:, :2], axis=-1) < 7
    assert found[near & (x < -4)].min() > found[near & (x > 4)].max()


def test_an_untouched_skin_is_flat():
    from jaxunshear.simulator.contact_results import Skins
    from jaxunshear.simulator.systems import load_shared_dome

    force = np.zeros((2, len(load_shared_dome(TACTIP_331).nodes), 3))
    np.testing.assert_array_equal(
        compute_indentation(TACTIP_331, Skins(force, np.zeros((2, 6)))), 0
    )
