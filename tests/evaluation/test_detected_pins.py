"""Pins detected in simulated images: which pairs are scored, and what is compared with what."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.data import PairedData
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import PinPoseNet, PinUnshear
from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.config.targets import count_outputs, make_range_targets
from jaxunshear.data.sources import PinLayout
from jaxunshear.evaluation.network_outputs import make_run
from jaxunshear.evaluation.simulated_evaluation import (
    DETECTED,
    DETECTED_TAP,
    build_simulated_results,
    detect_pairs,
)
from jaxunshear.models import pin_networks
from jaxunshear.models.modality import PINS
from jaxunshear.perception.drawing import draw_dots
from jaxunshear.perception.lattice_fitting import compute_rest_lattice
from jaxunshear.report import score_sections, wording
from tests.report.conftest import made_up_gathered

SETTINGS = PairedData()
SIZE = SETTINGS.preprocess.size
LATTICE = compute_rest_lattice(TACTIP_331, SETTINGS.camera, SETTINGS.preprocess)
MOVES = np.array([[0.0, 0.0], [2.0, -1.0], [0.5, 3.0]])  # px, of the pins of a slide
TARGETS = make_range_targets((), SETTINGS.ranges)


def drawn(pins):
    return np.asarray(draw_dots(jnp.asarray(pins, jnp.float32), 1.6, SIZE)).astype(np.uint8) * 255


class Reader:
    """Three taps at rest, and slides that move all pins alike; `black` slides show nothing."""

    def __init__(self, black=()):
        self.black = list(black)

    def length(self, split):
        return len(MOVES)

    def take(self, split, rows, fields):
        tap = np.repeat(LATTICE.rest[None], len(MOVES), axis=0).astype(np.float32)
        slide = tap + MOVES[:, None].astype(np.float32)
        found = {
            "canonical_pins": tap,
            "sheared_pins": slide,
            "canonical": drawn(tap),
            "sheared": drawn(slide),
        }
        found["sheared"][self.black] = 0
        return {name: found.get(name, np.arange(len(MOVES)))[rows] for name in fields}


def test_pairs_that_are_followed_are_scored_and_the_others_counted():
    found = detect_pairs(Reader(black=[1]), LATTICE)
    assert found.pairs["pose_id"].tolist() == [0, 2]
    assert not {"canonical", "sheared"} & set(found.pairs)
    tap, slide = found.reported["tap"], found.reported["sheared"]
    assert slide["followed"] == pytest.approx(2 / 3) and tap["followed"] == 1
    assert tap["missing_per_image"] == 0 and 0 < slide["rms_px"] < 0.4
    rest = LATTICE.rest.astype(np.float32)
    np.testing.assert_array_equal(found.pairs["canonical_pins"][0], rest)  # as it is
    np.testing.assert_allclose(found.pairs[DETECTED_TAP][0], LATTICE.rest, atol=0.7)
    np.testing.assert_allclose(found.pairs["sheared_pins"][1] - MOVES[2], LATTICE.rest, atol=0.7)
    assert [len(batch["pose_id"]) for batch in found.make_test().batches] == [2]
    assert detect_pairs(Reader(black=range(3)), LATTICE) is None


def test_the_tap_is_read_as_found_and_the_unsheared_is_compared_with_the_true_one():
    shape = {"hidden": 8, "layers": 1}
    nets = {"disentangled": PinUnshear(**shape), "posenet": PinPoseNet(**shape)}
    counts = {"disentangled": 0, "posenet": count_outputs(TARGETS)}
    variables = {
        name: pin_networks.init(net, LATTICE.rest, 2.0, jax.random.key(1), outputs=counts[name])
        for name, net in nets.items()
    }
    layout = PinLayout(LATTICE.rest, 1.6, SIZE)
    run = jax.jit(make_run(nets, dict.fromkeys(nets, TARGETS), PINS, layout))
    run = partial(run, variables, None)
    tap = LATTICE.rest[None].astype(np.float32)
    noisy = tap + np.random.default_rng(0).normal(0, 1, tap.shape).astype(np.float32)
    (plain, true), (outputs, found) = run(tap, tap + 1), run(tap, tap + 1, noisy)
    of_noisy, _ = run(noisy, noisy)
    assert found.keys() == true.keys()
    for name, score in true.items():
        np.testing.assert_allclose(found[name], score, rtol=1e-6, err_msg=name)
    np.testing.assert_array_equal(outputs.images["tap"], plain.images["tap"])
    edge_mm = outputs.poses["tap"]["edge_mm"]
    np.testing.assert_allclose(edge_mm, of_noisy.poses["tap"]["edge_mm"], rtol=1e-5)
    assert np.abs(edge_mm - plain.poses["tap"]["edge_mm"]).max() > 1e-4


def test_the_page_gives_how_many_were_followed():
    gathered = made_up_gathered()
    reported = {"images": 480, "followed": 0.975, "rms_px": 0.18, "missing_per_image": 0.0}
    followed = {DETECTED: {"tap": reported, "sheared": reported | {"followed": 0.5}}}
    results = build_simulated_results(
        Experiment("made up", "none"), gathered, {DETECTED: gathered}, followed
    )
    page = score_sections.build_further_tests(results, wording.describe(results))
    assert "97.5% of taps followed, 0.18 px off; 50.0% of slides followed" in page
