"""The dome of a small sensor: covered angle, materials, sensitivity, mesh, cache."""

import hashlib
import io
import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jaxunshear.config.contact_rings import (
    compute_contact_angle,
    compute_max_depth_mm,
    compute_reach_mm,
    compute_ring_arcs,
)
from jaxunshear.config.sensor import SENSORS, TACTIP_127, TACTIP_331, Sensor, check_sensor
from jaxunshear.errors import UserError
from jaxunshear.simulator import elasticity
from jaxunshear.simulator.dome import (
    VERSION,
    compute_dome,
    count_dome_steps,
    load_dome,
    load_sensitivity,
)
from jaxunshear.simulator.harmonics import make_sixfold_permutations
from jaxunshear.simulator.pin_layout import compute_pin_levers, compute_pin_tips

SMALL = Sensor(
    "small",
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
    for sensor in (each for each in SENSORS.values() if not each.is_flat):
        np.testing.assert_array_equal(compute_ring_arcs(sensor), np.arange(22.0))
        assert 60 <= compute_contact_angle(sensor) < 60.5
    for radius in (1.0, 5.0, 12.0, 19.9, 20.5, 35.0, 200.0):
        sensor = replace(TACTIP_331, dome_radius_mm=radius)
        assert 9 <= len(compute_ring_arcs(sensor)) <= 22
        assert abs(compute_contact_angle(sensor) - 60) < 3.5


def test_the_deepest_contact_reaches_the_last_ring():
    radius = TACTIP_331.dome_radius_mm
    last = compute_ring_arcs(TACTIP_331)[-1] / radius
    level = compute_max_depth_mm(TACTIP_331)
    assert compute_reach_mm(TACTIP_331, level) == pytest.approx(radius * np.sin(last))
    assert level > 10
    tilted = compute_max_depth_mm(TACTIP_331, 25.0)
    assert tilted == compute_max_depth_mm(TACTIP_331, -25.0)
    half_angle = np.degrees(np.arccos(1 - tilted / radius))
    assert half_angle + 25 == pytest.approx(compute_contact_angle(TACTIP_331))
    assert compute_max_depth_mm(TACTIP_331, 90.0) == 0


def test_nodes_and_pins_stand_on_the_dome(small):
    centre = np.array([0, 0, SMALL.dome_radius_mm])
    np.testing.assert_allclose(np.linalg.norm(small.nodes - centre, axis=-1), 6.0, atol=1e-3)
    levers = compute_pin_levers(SMALL)
    feet = compute_pin_tips(SMALL) - levers
    np.testing.assert_allclose(np.linalg.norm(feet - centre, axis=-1), 5.5)
    np.testing.assert_allclose(np.linalg.norm(levers, axis=-1), 0.5)
    assert small.g.shape == (3 * SMALL.pins, len(small.w))


@pytest.mark.parametrize("layout", ["rings", "hexagonal"])
def test_a_turn_by_60_degrees_changes_nothing(layout):
    made = compute_dome(replace(SMALL, layout=layout))
    force = np.random.default_rng(0).normal(size=made.nodes.shape)
    turn = np.array([[0.5, -np.sqrt(0.75), 0], [np.sqrt(0.75), 0.5, 0], [0, 0, 1]])
    turned = np.empty_like(force)
    turned[make_sixfold_permutations(len(force))[1]] = force @ turn.T
    for matrix, points in ((made.w, made.nodes), (made.g, made.pins)):
        image = make_sixfold_permutations(len(points))[1]
        np.testing.assert_allclose(points[image], points @ turn.T, atol=1e-9)
        before, after = ((matrix @ f.ravel()).reshape(-1, 3) for f in (force, turned))
        np.testing.assert_allclose(after[image], before @ turn.T, atol=1e-10 * np.abs(before).max())


def with_modulus(ratio, poisson, gel=0.1):
    moduli = {"skin_modulus_mpa": ratio * gel, "gel_modulus_mpa": gel}
    return replace(SMALL, **moduli, skin_poisson=poisson, gel_poisson=poisson)


@pytest.mark.parametrize("ratio", [1e-2, pytest.param(1.0, marks=pytest.mark.long), 1e6])
@pytest.mark.parametrize("poisson", [0.0, 0.49, 0.4999])
def test_extreme_materials_leave_it_positive_definite(ratio, poisson):
    made = compute_dome(with_modulus(ratio, poisson))
    assert np.isfinite(made.w).all() and np.isfinite(made.g).all()
    np.testing.assert_array_equal(made.w, made.w.T)
    eigenvalues = np.linalg.eigvalsh(made.w)
    assert eigenvalues[0] > 1e-6 * eigenvalues[-1]


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_both_moduli_together_only_scale(scale):
    made, scaled = (compute_dome(with_modulus(1e4, 0.4999, gel)) for gel in (0.1, 0.1 * scale))
    for before, after in ((made.w, scaled.w), (made.g, scaled.g)):
        np.testing.assert_allclose(scale * after, before, atol=1e-9 * np.abs(before).max())


def test_harmonics_that_a_ring_does_not_bear_add_little(small, monkeypatch):
    monkeypatch.setattr(elasticity, "compute_ring_sizes", lambda rings: np.full(rings, 1000))
    more = compute_dome(SMALL)
    assert 0 < np.linalg.norm(more.w - small.w) / np.linalg.norm(small.w) < 3e-4


def test_sensitivity_is_the_derivative_by_the_moduli(cache, small):
    def compute_difference(field, step=1e-3):
        value = getattr(SMALL, field)
        above, below = (
            compute_dome(replace(SMALL, **{field: value * np.exp(s)})) for s in (step, -step)
        )
        return (above.w - below.w) / (2 * step), (above.g - below.g) / (2 * step)

    dw, dg = load_sensitivity(SMALL)
    expected = {"skin_modulus_mpa": (dw, dg), "gel_modulus_mpa": (-small.w - dw, -small.g - dg)}
    for field, slopes in expected.items():
        for ours, theirs in zip(slopes, compute_difference(field), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6 * np.abs(ours).max())


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("dome_radius_mm", np.nan), ("skin_mm", -1.0), ("skin_mm", np.inf)),
        *(("gel_modulus_mpa", 0.0), ("skin_modulus_mpa", np.nan)),
        *(("gel_poisson", 0.5), ("skin_poisson", np.nan)),
        *(("layout", "square"), ("pin_length_mm", -0.1), ("rings", 0), ("rings", 30)),
    ],
)
def test_impossible_sensors_are_refused_by_field(cache, field, value):
    for attempt in (check_sensor, load_dome, compute_pin_tips):
        with pytest.raises(UserError, match=field):
            attempt(replace(TACTIP_331, **{field: value}))
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


def _read(path):
    return dict(np.load(io.BytesIO(path.read_bytes()[32:])))


def _store(path, **changes):
    """Change what a file holds, and its checksum."""
    stream = io.BytesIO()
    np.savez(stream, **{**_read(path), **changes})
    path.write_bytes(hashlib.sha256(stream.getvalue()).digest() + stream.getvalue())


def _flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def test_a_full_cache_file_is_used(stored, small, capsys):
    _store(stored, rings=2 * _read(stored)["rings"])  # which nobody would make again
    loaded = load_dome(SMALL)
    np.testing.assert_allclose(loaded.w, 2 * small.w, rtol=1e-12)
    for name in ("g", "nodes", "pins"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(small, name))
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda path: path.write_bytes(b""), "checksum"),
        (lambda path: path.write_bytes(path.read_bytes()[:-100]), "checksum"),
        (_flip, "checksum"),
        (lambda path: path.write_bytes(hashlib.sha256(b"text").digest() + b"text"), "pickle"),
        (lambda path: _store(path, settings=np.array("{}")), "other settings"),
    ],
)
def test_a_damaged_cache_file_is_reported_and_made_again(stored, small, capsys, damage, reason):
    full = stored.read_bytes()
    damage(stored)
    capsys.readouterr()
    np.testing.assert_array_equal(load_dome(SMALL).w, small.w)
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "made again" in line]
    assert str(stored) in line and reason in line
    assert stored.read_bytes() == full and len(list(stored.parent.iterdir())) == 1


def test_a_progress_of_others_counts_what_is_computed(cache, small, capsys):
    counted: list[float] = []

    class Work:
        def advance(self, n=1):
            counted.append(n)

    steps = count_dome_steps(SMALL)
    load_dome(SMALL, Work())
    assert sum(counted) == steps > 1 and count_dome_steps(SMALL) == 0
    load_dome(SMALL, Work())
    assert sum(counted) == steps and capsys.readouterr().err == ""


def test_other_settings_have_other_files(stored):
    assert json.loads(str(_read(stored)["settings"]))["version"] == VERSION
    load_dome(replace(SMALL, gel_modulus_mpa=0.2))
    load_dome(replace(SMALL, name="../sly"))
    assert len(list(stored.parent.iterdir())) == 3


def test_two_processes_at_once_do_each_other_no_harm(cache, small):
    code = (
        "from jaxunshear.config.sensor import Sensor; "
        "from jaxunshear.simulator.dome import load_dome; "
        f"print(load_dome({SMALL!r}).w.sum())"
    )
    command = [sys.executable, "-c", code]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
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
