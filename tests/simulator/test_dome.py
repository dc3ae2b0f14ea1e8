"""The dome of a small sensor: covered angle, materials, sensitivity, mesh, cache."""

import hashlib
import io
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jaxunshear.config.reach import (
    compute_contact_angle,
    compute_max_depth_mm,
    compute_reach_mm,
    compute_ring_arcs,
)
from jaxunshear.config.sensor import SENSORS, TACTIP_127, TACTIP_331, Sensor, check_sensor
from jaxunshear.errors import UserError
from jaxunshear.simulator import elasticity
from jaxunshear.simulator.dome import VERSION, compute_dome, load_dome, load_sensitivity
from jaxunshear.simulator.harmonics import make_sixfold_permutations
from jaxunshear.simulator.pin_layout import compute_pin_levers, compute_pin_tips

SMALL = Sensor(
    name="small",
    dome_radius_mm=6.0,
    skin_mm=0.5,
    rings=3,
    pin_spacing_mm=1.0,
    pin_radius_mm=0.3,
    pin_length_mm=0.5,
)


@pytest.fixture(scope="module")
def small():
    return compute_dome(SMALL)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXUNSHEAR_CACHE", str(tmp_path))
    return tmp_path


def test_the_rings_of_the_sensors_cover_sixty_degrees():
    for sensor in SENSORS.values():
        np.testing.assert_array_equal(compute_ring_arcs(sensor), np.arange(22.0))
        assert 60 <= compute_contact_angle(sensor) < 60.5
    for radius in (1.0, 5.0, 12.0, 19.9, 20.5, 35.0, 200.0):
        sensor = replace(TACTIP_331, dome_radius_mm=radius)
        assert (
            9 <= len(compute_ring_arcs(sensor)) <= 22
            and abs(compute_contact_angle(sensor) - 60) < 3.5
        )
    assert compute_ring_arcs(replace(TACTIP_331, dome_radius_mm=12.0))[1] == 1.0


def test_the_deepest_contact_reaches_the_last_ring():
    last = compute_ring_arcs(TACTIP_331)[-1] / TACTIP_331.dome_radius_mm
    level = compute_max_depth_mm(TACTIP_331)
    assert compute_reach_mm(TACTIP_331, level) == pytest.approx(
        TACTIP_331.dome_radius_mm * np.sin(last)
    )
    assert level > 10
    tilted = compute_max_depth_mm(TACTIP_331, 25.0)
    assert tilted == compute_max_depth_mm(TACTIP_331, -25.0)
    half_angle = np.degrees(np.arccos(1 - tilted / TACTIP_331.dome_radius_mm))
    assert half_angle + 25 == pytest.approx(compute_contact_angle(TACTIP_331))
    assert compute_max_depth_mm(TACTIP_331, 90.0) == 0


def test_nodes_and_pins_stand_on_the_dome(small):
    centre = np.array([0, 0, SMALL.dome_radius_mm])
    np.testing.assert_allclose(np.linalg.norm(small.nodes - centre, axis=-1), 6.0, atol=1e-3)
    stands = compute_pin_tips(SMALL) - compute_pin_levers(SMALL)
    np.testing.assert_allclose(np.linalg.norm(stands - centre, axis=-1), 5.5)
    np.testing.assert_allclose(np.linalg.norm(compute_pin_levers(SMALL), axis=-1), 0.5)
    assert small.w.shape == (3 * len(small.nodes),) * 2 and small.g.shape == (
        3 * SMALL.pins,
        3 * len(small.nodes),
    )


@pytest.mark.parametrize("layout", ["rings", "hexagonal"])
def test_a_turn_by_60_degrees_changes_nothing(layout):
    made = compute_dome(replace(SMALL, layout=layout))
    force = np.random.default_rng(0).normal(size=made.nodes.shape)
    turn = np.array([[0.5, -np.sqrt(0.75), 0], [np.sqrt(0.75), 0.5, 0], [0, 0, 1]])
    for matrix, points in ((made.w, made.nodes), (made.g, made.pins)):
        image = make_sixfold_permutations(len(points))[1]
        np.testing.assert_allclose(points[image], points @ turn.T, atol=1e-9)
        turned = np.empty_like(force)
        turned[make_sixfold_permutations(len(force))[1]] = force @ turn.T
        before, after = ((matrix @ f.ravel()).reshape(-1, 3) for f in (force, turned))
        np.testing.assert_allclose(after[image], before @ turn.T, atol=1e-10 * np.abs(before).max())


@pytest.mark.parametrize("ratio", [1e-2, pytest.param(1.0, marks=pytest.mark.long), 1e6])
@pytest.mark.parametrize("poisson", [0.0, 0.49, 0.4999])
def test_extreme_materials_leave_it_positive_definite(ratio, poisson):
    made = compute_dome(with_modulus(ratio, poisson))
    assert np.isfinite(made.w).all() and np.isfinite(made.g).all()
    np.testing.assert_array_equal(made.w, made.w.T)
    eigenvalues = np.linalg.eigvalsh(made.w)
    assert eigenvalues[0] > 1e-6 * eigenvalues[-1]


def with_modulus(ratio, poisson, gel=0.1):
    return replace(
        SMALL,
        skin_modulus_mpa=ratio * gel,
        gel_modulus_mpa=gel,
        skin_poisson=poisson,
        gel_poisson=poisson,
    )


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_both_moduli_together_only_scale(scale):
    made, scaled = (compute_dome(with_modulus(1e4, 0.4999, gel)) for gel in (0.1, 0.1 * scale))
    np.testing.assert_allclose(scale * scaled.w, made.w, atol=1e-9 * np.abs(made.w).max())
    np.testing.assert_allclose(scale * scaled.g, made.g, atol=1e-9 * np.abs(made.g).max())


def test_harmonics_that_a_ring_does_not_bear_add_little(small, monkeypatch):
    monkeypatch.setattr(elasticity, "compute_ring_sizes", lambda rings: np.full(rings, 1000))
    more = compute_dome(SMALL)
    difference = np.linalg.norm(more.w - small.w) / np.linalg.norm(small.w)
    assert 0 < difference < 3e-4


def test_sensitivity_is_the_derivative_by_the_skins_modulus(cache, small):
    dw, dg = load_sensitivity(SMALL)
    step = 1e-3
    up, down = (
        compute_dome(replace(SMALL, skin_modulus_mpa=SMALL.skin_modulus_mpa * np.exp(s)))
        for s in (step, -step)
    )
    for exact, above, below in ((dw, up.w, down.w), (dg, up.g, down.g)):
        np.testing.assert_allclose(
            exact, (above - below) / (2 * step), rtol=1e-5, atol=1e-6 * np.abs(exact).max()
        )
    step_gel = (
        compute_dome(replace(SMALL, gel_modulus_mpa=SMALL.gel_modulus_mpa * np.exp(s)))
        for s in (step, -step)
    )
    above, below = (made.g for made in step_gel)
    np.testing.assert_allclose(
        -small.g - dg, (above - below) / (2 * step), rtol=1e-5, atol=1e-6 * np.abs(dg).max()
    )


@pytest.mark.parametrize(
    "wrong",
    [
        {"dome_radius_mm": np.nan},
        {"skin_mm": -1.0},
        {"skin_mm": np.inf},
        {"gel_modulus_mpa": 0.0},
        {"skin_modulus_mpa": np.nan},
        {"gel_poisson": 0.5},
        {"skin_poisson": np.nan},
        {"layout": "square"},
        {"pin_length_mm": -0.1},
        {"rings": 0},
    ],
)
def test_impossible_sensors_are_refused_by_field(cache, wrong):
    (field,) = wrong
    for attempt in (check_sensor, load_dome, compute_pin_tips):
        with pytest.raises(UserError, match=field):
            attempt(replace(TACTIP_331, **wrong))
    with pytest.raises(UserError, match="dome_radius_mm"):
        check_sensor(replace(TACTIP_127, skin_mm=21.0))
    assert not list(cache.iterdir())


@pytest.fixture(scope="module")
def kept(small, tmp_path_factory):
    folder = tmp_path_factory.mktemp("kept")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAXUNSHEAR_CACHE", str(folder))
        np.testing.assert_array_equal(load_dome(SMALL).w, small.w)
    (path,) = folder.iterdir()
    return path


@pytest.fixture
def stored(cache, kept):
    """The cache file of SMALL."""
    return Path(shutil.copy(kept, cache))


def _contents(path):
    return dict(np.load(io.BytesIO(path.read_bytes()[32:])))


def _store(path, contents):
    """With the right checksum."""
    stream = io.BytesIO()
    np.savez(stream, **contents)
    path.write_bytes(hashlib.sha256(stream.getvalue()).digest() + stream.getvalue())


def test_a_full_cache_file_is_used(stored, small, capsys):
    for name in ("w", "g", "nodes", "pins"):
        np.testing.assert_array_equal(getattr(load_dome(SMALL), name), getattr(small, name))
    _store(
        stored, {**_contents(stored), "rings": 2 * _contents(stored)["rings"]}
    )  # which nobody would make again
    np.testing.assert_allclose(load_dome(SMALL).w, 2 * small.w, rtol=1e-12)
    assert capsys.readouterr().err == ""


def _flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def _changed(**values):
    return lambda path: _store(path, {**_contents(path), **values})


def _not_finite(path):
    contents = _contents(path)
    contents["rings"][3, 2, 1] = np.nan
    _store(path, contents)


def _without(path):
    contents = _contents(path)
    del contents["fields"]
    _store(path, contents)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda path: path.write_bytes(b""), "checksum"),
        (lambda path: path.write_bytes(path.read_bytes()[:-100]), "checksum"),
        (_flip, "checksum"),
        (lambda path: path.write_bytes(hashlib.sha256(b"text").digest() + b"text"), "pickle"),
        (_changed(settings=np.array("{}")), "other settings"),
        (_changed(rings=np.zeros((2, 3, 3))), "rings are not"),
        (_changed(positions=np.zeros(5, int)), "positions are not"),
        (_not_finite, "rings are not"),
        (_without, "fields"),
    ],
)
def test_a_cache_file_that_is_not_right_is_reported_and_made_again(
    stored, small, capsys, damage, said
):
    full = stored.read_bytes()
    damage(stored)
    capsys.readouterr()
    np.testing.assert_array_equal(load_dome(SMALL).w, small.w)
    reported = [line for line in capsys.readouterr().err.splitlines() if "made again" in line]
    assert len(reported) == 1 and str(stored) in reported[0] and said in reported[0]
    assert stored.read_bytes() == full and len(list(stored.parent.iterdir())) == 1


def test_other_settings_have_other_files(stored):
    settings = str(_contents(stored)["settings"])
    assert json.loads(settings)["version"] == VERSION
    assert hashlib.sha256(settings.encode()).hexdigest().startswith(stored.stem.split("-")[-1])
    load_dome(replace(SMALL, gel_modulus_mpa=0.2))
    load_dome(replace(SMALL, name="../sly"))
    assert len(list(stored.parent.iterdir())) == 3


def test_two_processes_at_once_do_each_other_no_harm(cache, small, tmp_path):
    code = (
        "from jaxunshear.config.sensor import Sensor; "
        "from jaxunshear.simulator.dome import load_dome; "
        f"print(load_dome({SMALL!r}).w.sum())"
    )
    environment = {**os.environ, "JAXUNSHEAR_CACHE": str(cache)}
    running = [
        subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment
        )
        for _ in range(2)
    ]
    for process in running:
        assert float(process.communicate()[0]) == small.w.sum() and process.returncode == 0
    (path,) = cache.iterdir()
    assert path.suffix == ".bin"


def test_a_cache_folder_that_cannot_be_written_to_is_reported(tmp_path, monkeypatch, capsys):
    """Before the work, which would show its progress."""
    (tmp_path / "file").touch()
    monkeypatch.setenv("JAXUNSHEAR_CACHE", str(tmp_path / "file"))
    with pytest.raises(UserError, match="JAXUNSHEAR_CACHE"):
        load_dome(SMALL)
    assert capsys.readouterr().err == ""
