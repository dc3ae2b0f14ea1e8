"""A flat pad: an elastic layer on a plate, its contacts, its limits, and the frames of its camera."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.angles import rotate_2d
from jaxunshear.apps.explore.explorer import make_explorer
from jaxunshear.calibration.calibrate import calibrate
from jaxunshear.config.contact_rings import compute_max_contact_depth_mm, compute_ring_arcs
from jaxunshear.config.fields import override_fields
from jaxunshear.config.load import load_experiment
from jaxunshear.config.rules import validate
from jaxunshear.config.sensor import GEL_PAD, PAD_CAMERA, Nuisance, Preprocess, check_sensor
from jaxunshear.config.serialization import from_json, to_json
from jaxunshear.data.sensor_frame import match_sensor
from jaxunshear.errors import UserError
from jaxunshear.perception.lattice_fitting import compute_rest_lattice, fit_lattice, make_layout
from jaxunshear.perception.pin_detection import detect_pins
from jaxunshear.perception.pin_tracking import track_all
from jaxunshear.perception.preprocess import binarise
from jaxunshear.perception.touch import make_touch_gauge, measure_touch
from jaxunshear.simulator.camera import compute_outer_fraction, project, render_frame
from jaxunshear.simulator.contacts import compute_indentation
from jaxunshear.simulator.dome import compute_dome, load_shared_dome
from jaxunshear.simulator.gradient import make_pin_model, simulate_pins
from jaxunshear.simulator.harmonics import make_sixfold_permutations
from jaxunshear.simulator.mesh import make_pad_mesh
from jaxunshear.simulator.paths import Paths
from jaxunshear.simulator.pin_layout import compute_pin_levers, compute_pin_tips
from jaxunshear.simulator.scene import make_scenes
from jaxunshear.simulator.simulate import follow, simulate
from verification.elastic_layer import check_layer

ROOT = Path(__file__).resolve().parents[2]
SHAPES = ("edge", "disk", "clover", "teardrop")
FRICTION = 0.7


@pytest.fixture(scope="module")
def pad():
    return load_shared_dome(GEL_PAD)


def make_contacts(count):
    """Make poses (2 count, 4) and moves of taps, and then of slides to the same poses."""
    generator = np.random.default_rng(0)
    lowest, highest = [-5, -5, -180, 0.3], [5, 5, 180, 1.2]
    pose = np.tile(generator.uniform(lowest, highest, (count, 4)), (2, 1))
    move = np.zeros((2 * count, 3))
    move[count:, :2] = generator.uniform(-1.5, 1.5, (count, 2))
    kinds = np.arange(2 * count) % len(SHAPES)
    return make_scenes(SHAPES, kinds, pose, move, FRICTION)


@pytest.fixture(scope="module")
def contacts():
    return simulate(GEL_PAD, SHAPES, make_contacts(12))


def press(points, stimulus="surface", friction=FRICTION, level="auto"):
    """Follow one path (K, 6) over a stimulus."""
    paths = Paths(np.zeros(1, int), np.array([friction]), np.array(points, float)[None])
    return follow(GEL_PAD, (stimulus,), paths, level)


def test_the_mesh_is_a_clamped_cylinder():
    mesh = make_pad_mesh(16.0, 4.0, 0.5, 1.0)
    corners = mesh.nodes[mesh.elements[:, :4]]
    sides = corners.max(axis=1) - corners.min(axis=1)
    volume = 2 * np.pi * np.sum(sides.prod(axis=1) * corners[..., 0].mean(axis=1))
    assert volume == pytest.approx(np.pi * 16**2 * 4)
    skin = sides[mesh.skin].prod(axis=1).sum() / sides.prod(axis=1).sum()
    assert skin == pytest.approx(0.5 / 4)
    np.testing.assert_array_equal(mesh.nodes[mesh.clamped, 1], 4.0)
    np.testing.assert_array_equal(mesh.nodes[mesh.surface.ravel(), 1], 0.0)
    assert mesh.surface[0, 0] in mesh.axis and mesh.nodes[mesh.surface[-1, 2], 0] == 16


@pytest.mark.parametrize(("thickness_mm", "poisson"), [(2.0, 0.3), (4.0, 0.49)])
def test_a_pad_of_one_material_is_an_elastic_layer(thickness_mm, poisson):
    rows = check_layer(((thickness_mm, poisson),))
    assert len(rows) == 3 and all(row.holds for row in rows)


def test_its_compliance_is_symmetric_positive_and_the_same_after_a_sixth_of_a_turn(pad):
    np.testing.assert_array_equal(pad.w, pad.w.T)
    assert np.linalg.eigvalsh(pad.w)[0] > 0
    force = np.random.default_rng(0).normal(size=pad.nodes.shape)
    turn = np.array([[0.5, -np.sqrt(0.75), 0], [np.sqrt(0.75), 0.5, 0], [0, 0, 1]])
    turned, image = np.empty_like(force), make_sixfold_permutations(len(force))[1]
    turned[image] = force @ turn.T
    before, after = ((pad.w @ f.ravel()).reshape(-1, 3) for f in (force, turned))
    np.testing.assert_allclose(after[image], before @ turn.T, atol=1e-10 * np.abs(before).max())


def test_markers_rest_beneath_the_skin(pad):
    tips = compute_pin_tips(GEL_PAD)
    assert tips.shape == (165, 3) and np.all(tips[:, 2] == GEL_PAD.skin_mm)
    assert not compute_pin_levers(GEL_PAD).any()
    np.testing.assert_allclose(np.linalg.norm(pad.nodes, axis=-1).max(), 15.0)
    assert compute_outer_fraction(PAD_CAMERA, GEL_PAD) == pytest.approx(0.375, abs=1e-3)


def test_contacts_converge_near_the_reference(contacts):
    assert contacts.converged.all() and not contacts.retried.any()
    quick, exact = (
        simulate(GEL_PAD, SHAPES, make_contacts(4), each) for each in ("auto", "reference")
    )
    here, there, rest = (
        np.asarray(project(PAD_CAMERA, tips, GEL_PAD))
        for tips in (quick.pins, exact.pins, compute_pin_tips(GEL_PAD))
    )
    errors = np.sqrt(np.square(here - there).sum(-1).mean(-1))
    motions = np.sqrt(np.square(there - rest).sum(-1).mean(-1))
    assert errors.max() < 0.3 and motions.min() > 3 * errors.max()
    np.testing.assert_allclose(quick.force_n[:, 2], exact.force_n[:, 2], rtol=0.05)


def test_slides_drag_the_markers_along(contacts):
    taps, slides = contacts.pins[:12], contacts.pins[12:]
    scenes = make_contacts(12)
    yaw, move = np.radians(scenes.pose[12:, 2]), scenes.move[12:, :2]
    # the move in the sensor frame; friction drags the skin the other way
    along = rotate_2d(move, -yaw)
    dragged = (slides - taps)[..., :2].mean(axis=1)
    cosine = np.sum(dragged * along, -1) / np.prod(
        [np.linalg.norm(each, axis=-1) for each in (dragged, along)], axis=0
    )
    assert cosine.max() < -0.9


def test_a_long_slide_over_a_plane_has_the_full_friction():
    contact, _ = press([[0] * 6, [0, 0, 0, 0.3, 0, 0], [6, 0, 0, 0.3, 0, 0]])
    assert contact.converged.all() and not contact.stuck_nodes.any()
    x, y, z = contact.force_n[0]
    assert np.hypot(x, y) == pytest.approx(FRICTION * z, rel=1e-3) and x < 0


def test_friction_holds_the_face_back_even_in_a_shallow_tap():
    stuck, free = (press([[0] * 6, [0, 0, 0, 0.4, 0, 0]], "disk", mu)[0] for mu in (FRICTION, 0))
    spread_stuck, spread_free = (
        np.linalg.norm((each.pins[0] - compute_pin_tips(GEL_PAD))[:, :2], axis=-1).max()
        for each in (stuck, free)
    )
    assert spread_stuck < 0.7 * spread_free


def test_a_tilted_pad_is_pressed_on_the_side_that_is_lower():
    flat, tilted = (
        press([[0, 0, 0, 0, *tilt], [0, 0, 0, 0.5, *tilt]])[1] for tilt in ((0, 0), (0, 2))
    )
    nodes = load_shared_dome(GEL_PAD).nodes
    middles = [
        each.force_n[0, :, 2] @ nodes / each.force_n[0, :, 2].sum() for each in (flat, tilted)
    ]
    assert np.abs(middles[0]).max() < 0.05
    lowest = nodes[np.argmin(nodes[:, 2] - np.sin(np.radians(2)) * nodes[:, 0])]
    assert lowest[0] > 0 and middles[1][0] > 1 and np.abs(middles[1][1]) < 0.1


def test_the_skin_of_a_press_goes_in_by_its_depth():
    path = [[0] * 6, [0, 0, 0, 0.5, 0, 0]]
    exact, skins = press(path, level="reference")
    share = press(path)[0].force_n[0, 2] / exact.force_n[0, 2]
    assert 0.9 < share < 1.02
    np.testing.assert_allclose(compute_indentation(GEL_PAD, skins), 0.5, atol=0.02)


def test_the_camera_shows_every_marker_and_tracking_follows_them(contacts):
    preprocess = Preprocess(size=256)
    render = jax.jit(partial(render_frame, PAD_CAMERA, GEL_PAD, Nuisance()))
    keys = jax.random.split(jax.random.key(0), len(contacts.pins))
    images = [
        np.asarray(binarise(preprocess, render(*each)))
        for each in zip(contacts.pins, keys, strict=True)
    ]
    found = [detect_pins(image) for image in images]
    lattice = fit_lattice([each.pins for each in found], make_layout(GEL_PAD))
    tracks = track_all(lattice, found)
    assert np.mean([track.identified for track in tracks]) > 0.9
    truth = np.asarray(project(PAD_CAMERA, contacts.pins, GEL_PAD))
    for track, places in zip(tracks, truth, strict=True):
        if track.identified:
            error = np.linalg.norm(lattice.rest + track.motion - places, axis=-1)
            assert np.nanmax(error) < 1.0
    gauge = make_touch_gauge(compute_rest_lattice(GEL_PAD, PAD_CAMERA, preprocess), GEL_PAD)
    touch = measure_touch(gauge, truth)
    assert np.isnan(touch.contact).all()  # was learnt on domes
    assert np.isfinite(touch.divergence).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pad_mm": 0.4}, r"pad_mm = 0\.4: must exceed skin_mm"),
        ({"pad_mm": 17.0}, r"pad_mm = 17\.0: use at most the pad's radius"),
        ({"pad_mm": np.nan}, "pad_mm = nan"),
        ({"pad_radius_mm": 12.0}, r"rings = 7: pins 12\.9 mm from the apex go past the rim"),
        ({"skin_mm": -1.0}, "skin_mm"),
    ],
)
def test_a_pad_that_cannot_be_is_refused_by_name(changes, message):
    with pytest.raises(UserError, match=message):
        check_sensor(replace(GEL_PAD, **changes))


def test_contacts_that_are_too_deep_are_refused():
    deepest = compute_max_contact_depth_mm(GEL_PAD)
    assert deepest == pytest.approx(4 / 3)
    assert compute_max_contact_depth_mm(GEL_PAD, 2.0) == pytest.approx(
        deepest - 16 * np.sin(np.radians(2))
    )
    for points, message in (
        ([[0] * 6, [0, 0, 0, 1.5, 0, 0]], r"depth 1\.5 mm cannot be reached; .* covers 1\.3 mm"),
        ([[0] * 6, [0, 0, 0, 0, 0, 20]], "depth 0 mm cannot be reached at a tilt of 20 deg"),
        ([[0] * 6, [0, 0, 0, -1, 0, 20]], "depth -1 mm cannot be reached at a tilt of 20 deg"),
        ([[0, 0, 0, 0, 0, 2]] * 2, "its path stays where it begins"),
    ):
        with pytest.raises(UserError, match=message):
            press(points)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--sensor.pad_mm", "2"], r"depth_max_mm 1\.2: .* a pad 2 mm thick goes to 0\.67 mm"),
        (["--paired.ranges.tilt_deg", "4.9"], r"tilt_deg 4\.9: use 0 to below 4\.8, where the pad"),
        (["--paired.camera.distance_mm", "3"], r"must exceed the pad's thickness \(4\)"),
        (["--paired.ranges.move_mm", "17"], r"use 0 to 16 \(the pad's radius\)"),
    ],
)
def test_settings_that_a_pad_cannot_have_are_refused_in_its_own_words(words, message):
    experiment = override_fields(load_experiment(ROOT / "experiments" / "pad.py"), words)
    with pytest.raises(UserError, match=message):
        validate(experiment)


def test_an_experiment_on_a_pad_is_stored_and_read():
    experiment = load_experiment(ROOT / "experiments" / "pad.py")
    stored = json.loads(json.dumps(to_json(experiment)))
    assert from_json(stored) == experiment and "dome_radius_mm" not in stored["sensor"]


def test_derivatives_by_pose_agree_with_differences():
    points = np.array(
        [[[0, 0, 0, 0, 0, 0], [-3.0, 0.5, 20, 0.6, 0, 0], [-2.2, 0.5, 20, 0.6, 0, 0]]]
    )
    small = replace(GEL_PAD, rings=2, pad_radius_mm=6.0)
    paths = Paths(np.zeros(1, int), np.array([FRICTION]), points)
    with jax.enable_x64(True):
        model = make_pin_model(small, ("edge",), paths)

        def place(depth):
            moved = jnp.asarray(points).at[:, 1:, 3].set(depth)
            return simulate_pins(model, moved, jnp.asarray(paths.friction)).pins

        slope = jax.jacfwd(place)(0.6)
        difference = (place(0.6 + 1e-6) - place(0.6 - 1e-6)) / 2e-6
    assert np.abs(slope).max() > 0.1
    np.testing.assert_allclose(slope, difference, atol=2e-3 * np.abs(slope).max())


def test_what_is_about_domes_refuses_a_pad(tmp_path):
    with pytest.raises(UserError, match="gelpad165' is a pad, and only domes are calibrated: name"):
        calibrate(tmp_path, sensor=GEL_PAD)
    model = SimpleNamespace(require_simulation=lambda what: None, sensor=GEL_PAD)
    with pytest.raises(UserError, match="explore draws domes, and gelpad165 is a pad: name"):
        make_explorer(model)
    with pytest.raises(UserError, match=r"none of the known domes: .*`jaxunshear layout`"):
        match_sensor([165], 0.05, "here")


def test_wide_and_narrow_pads_have_nodes_up_to_their_rims():
    for radius in (6.0, 10.3, 15.5, 16.0, 16.4, 40.0):
        sensor = replace(GEL_PAD, rings=2, pad_radius_mm=radius)
        arcs = compute_ring_arcs(sensor)
        assert arcs[-1] + arcs[1] == pytest.approx(radius, rel=1e-9)
    small = compute_dome(replace(GEL_PAD, rings=2, pad_radius_mm=6.0))
    assert np.linalg.eigvalsh(small.w)[0] > 0
