"""Leakage of codes, on a toy skin whose pins show pose and slide by a known, linear law."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest

from jaxunshear.angles import rotate_2d
from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import PinNet, UnshearNet
from jaxunshear.config.sensor import Preprocess, Sensor
from jaxunshear.config.splits import SPLITS
from jaxunshear.config.targets import make_slide_targets
from jaxunshear.config.training import Training
from jaxunshear.data.reader import to_sensor_frame
from jaxunshear.data.simulation import SimulationEngine
from jaxunshear.data.stored_sets import make_set
from jaxunshear.errors import UserError
from jaxunshear.evaluation import codes, leakage, probe_data, probes
from jaxunshear.evaluation.codes import load_code_network
from jaxunshear.report.leakage_figure import plot_leakage
from jaxunshear.run import run_stages
from jaxunshear.training.checkpoint import read_slides

SENSOR = Sensor(name="small", rings=2)
SIZE = 32
DROPPED = 17  # this contact does not converge
CONTACTS = {"config": "tiny", "stimuli": ("disk",), "preprocess": Preprocess(size=SIZE)}
EXPERIMENT = Experiment(
    name="toy",
    claim="none",
    networks=("disentangled",),
    sensor=SENSOR,
    paired=PairedData(**CONTACTS, poses=60, slides=2, poses_a_slide=2),
    pose=PoseData(**CONTACTS, poses=10),
    unshear=UnshearNet(size=SIZE, widths=(4, 4), input="pins"),
    pins=PinNet(hidden=8, layers=1, pose_code=3, shear_code=2, separate_encoders=True),
    train_pins=Training(
        epochs=2,
        batch=8,
        shift=0.0,
        losses=dict.fromkeys(("supervised", "reconstruction", "counterfactual", "slide"), 1.0)
        | {"code_agreement": 0.1},
    ),
)
SLIDES = make_slide_targets(EXPERIMENT.paired.ranges)


def simulate(sensor, names, scenes):
    """Move pins by x and y of the pose and by the slide in the sensor frame. Long slides slip."""
    rng = np.random.default_rng(0)
    slide = rotate_2d(scenes.move, -np.radians(scenes.pose[:, 2]))
    given = np.concatenate([scenes.pose[:, :2] / 5, 3 * slide / 2.5], axis=1)
    tips = (given @ rng.normal(size=(4, 2 * sensor.pins))).reshape(len(scenes), sensor.pins, 2)
    converged = np.arange(len(scenes)) != (DROPPED if len(scenes) > DROPPED else -1)
    count = np.zeros(len(scenes), int)
    slips = np.linalg.norm(scenes.move, axis=1) > 1.5
    return SimpleNamespace(
        pins=np.concatenate([tips, tips[..., :1]], axis=-1).astype(np.float32),
        residual_mm=np.zeros(len(scenes), np.float32),
        converged=converged,
        retried=np.zeros(len(scenes), bool),
        stuck_nodes=1 - slips,
        slipping_nodes=count + slips,
        **dict.fromkeys(("iterations", "free_nodes"), count),
    )


def render(settings, sensor, tips, number, age):
    rest = np.random.default_rng(1).uniform(5, SIZE - 5, (1, sensor.pins, 2))
    images = np.random.default_rng(2).random((len(tips), SIZE, SIZE)) < 0.3
    return images.astype(np.uint8) * np.uint8(255), (rest + tips[..., :2]).astype(np.float32)


ENGINE = SimulationEngine(lambda sensor, names, scenes: [np.arange(len(scenes))], simulate, render)


@pytest.fixture(scope="module", autouse=True)
def short_probes():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(probes, "STEPS", 120)
        patch.setattr(probes, "TREES", 20)
        few = {name: probes.FAMILIES[name] for name in ("linear", "neighbours")}
        patch.setattr(leakage, "FAMILIES", few)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Data sets and a trained network of the toy."""
    folder = tmp_path_factory.mktemp("toy")
    for settings in (EXPERIMENT.paired, EXPERIMENT.pose):
        make_set(settings, SENSOR, folder / "data", ENGINE)
    run_stages(EXPERIMENT, ("disentangled",), folder / "runs", folder / "data", "none")
    return folder


@pytest.fixture(scope="module")
def found(folder):
    return leakage.measure_leakage(EXPERIMENT, folder / "runs" / "toy", folder / "data", "none")


def test_every_quantity_is_asked_of_every_code_by_every_family(found, folder):
    asked = {row["name"] for row in found["rows"]}
    pose = ("x_mm", "y_mm", "yaw_deg", "depth_mm", "edge_mm", "edge_deg")
    quantities = (*pose, "slide_x_mm", "slide_y_mm")
    assert asked == {f"{quantity} from {z}" for quantity in quantities for z in ("z_s", "z_p")}
    leaks = {(row["what"], row["code"]) for row in found["rows"] if row["leak"]}
    assert leaks == {("pose", "z_s"), ("slide", "z_p")}
    stored = json.loads((folder / "runs" / "toy" / "leakage.json").read_text())
    assert stored["sizes"] == {"z_p": 3, "z_s": 2}
    for row in found["rows"]:
        low, high = row["r2 interval"]
        assert low - 1e-9 <= row["r2"] <= high + 1e-9
        assert row["families"].keys() == {"linear", "neighbours"}
        assert row["r2"] == max(row["families"].values()) == row["families"][row["family"]]
        assert row["ceiling"] is None or row["r2"] <= row["ceiling"]


def test_ceiling_and_floor_are_where_they_must_be(found):
    """The input gives x, y and the slide by a linear law; shuffled labels give nothing."""
    for row in found["rows"]:
        assert row["shuffled"] < 0.3
        if row["quantity"] in ("x_mm", "y_mm", "slide_x_mm", "slide_y_mm"):
            assert row["ceiling"] > 0.95


def test_summaries_are_means_over_what_has_a_ceiling(found):
    for row in found["summary"]:
        asked = [one for one in found["rows"] if row["name"] == f"{one['what']} from {one['code']}"]
        seen = [one for one in asked if one["ceiling"] is not None]
        assert row["r2"] == pytest.approx(np.mean([one["r2"] for one in seen]))
        assert row["quantities"] == [one["quantity"] for one in seen]
        hidden = {one["quantity"] for one in asked if one not in seen}
        assert set(row["without a ceiling"]) == hidden
        low, high = row["r2 interval"]
        assert low <= row["r2"] <= high


def test_what_the_input_does_not_show_is_named_and_left_out_of_shares():
    errors = leakage.Estimate("linear", np.ones(4), np.full(4, 2.0), {"linear": 0.5})

    def row(quantity, r2, ceiling):
        named = {"what": "slide", "code": "z_p", "quantity": quantity, "estimate": errors}
        return named | {"r2": r2, "ceiling": ceiling}

    rows = [row("slide_x_mm", 0.2, 0.8), row("slide_y_mm", -0.1, 0.5)]
    rows.append(row("slide_Rx_deg", 0.09, None))
    found = leakage._summarise(rows, ("slide", "z_p"), np.arange(4))
    assert found["quantities"] == ["slide_x_mm", "slide_y_mm"]
    assert found["without a ceiling"] == ["slide_Rx_deg"]
    assert found["share"] == pytest.approx((0.25 + 0) / 2)
    assert found["largest share"] == pytest.approx(0.25)
    blind = leakage._summarise(rows[2:], ("slide", "z_p"), np.arange(4))
    assert not blind["quantities"] and "share" not in blind


def test_the_slide_is_read_with_an_interval(found):
    assert [(row["name"], row["part"]) for row in found["slide"]] == [
        (f"slide_{axis}_mm", part) for axis in "xy" for part in ("all", "sticking", "slipped")
    ]
    assert all(0 <= row["coverage"] <= 1 and row["half_width"] > 0 for row in found["slide"])
    assert "95 % intervals hold" in leakage.format_table(found)


def test_exchanged_codes_stand_beside_the_contact_of_that_pose_and_slide(found, folder):
    drawn = found["exchanged"]["drawn"]
    assert set(drawn) == {"both of its own", "exchanged", "shear code not exchanged"}
    assert found["exchanged"]["ratio"] == pytest.approx(
        drawn["exchanged"]["rms_px"] / drawn["both of its own"]["rms_px"]
    )
    parts = found["exchanged"]["by slip"]
    assert [part["part"] for part in parts] == ["sticking", "slipped"]
    assert sum(part["slides"] for part in parts) == found["exchanged"]["slides"]
    for name, row in drawn.items():
        squares = [part["slides"] * part["drawn"][name]["rms_px"] ** 2 for part in parts]
        assert sum(squares) == pytest.approx(found["exchanged"]["slides"] * row["rms_px"] ** 2)
    exchanged = codes.exchange_codes(EXPERIMENT, folder / "runs" / "toy", folder / "data")
    assert exchanged.decoded.shape == exchanged.true.shape == (2, 2, SENSOR.pins, 2)
    # the toy's law: what two slides differ in at one pose they differ in at another
    np.testing.assert_allclose(
        exchanged.true[0, 0] - exchanged.true[0, 1],
        exchanged.true[1, 0] - exchanged.true[1, 1],
        atol=1e-3,
    )
    assert plot_leakage(found, exchanged)[:4] == plot_leakage(found, None)[:4] == b"\x89PNG"
    table = leakage.format_table(found)
    assert "a leak" in table and "codes exchanged" in table


def test_a_sweep_gets_the_figures_and_can_leave_out_the_controls(found, folder):
    names = {row["name"] for row in leakage.build_sweep_rows(found)}
    assert {"pose from z_s", "slide_x_mm from z_p", "slide_x_mm, all", "standard scores"} <= names
    exchanged = {f"DS, codes {end}" for end in ("exchanged, sticking", "both of its own, slipped")}
    assert {"DS, codes exchanged", *exchanged} <= names
    run = folder / "runs" / "toy"
    fewer = leakage.measure_leakage(EXPERIMENT, run, folder / "data", "none", controls=False)
    full = {row["name"]: row["r2"] for row in found["rows"]}
    assert {row["name"]: row["r2"] for row in fewer["rows"]} == full  # the same bits
    assert not any("untrained" in row or "shuffled" in row for row in fewer["rows"])


def test_a_dropped_contact_is_nobodys_partner(folder):
    run = folder / "runs" / "toy"
    reader = leakage.open_examples(EXPERIMENT, "disentangled", folder / "data", run).reader
    assert sum(reader.length(split) for split in SPLITS) == 119


def test_what_has_no_shear_code_is_refused(trained):
    with pytest.raises(UserError, match="entangled holds no network with a shear code"):
        load_code_network(trained / "entangled")


def test_a_shear_code_that_is_taught_the_slide_says_it(folder, tmp_path):
    training = dataclasses.replace(EXPERIMENT.train_pins, epochs=12, learning_rate=1e-2)
    pins = dataclasses.replace(EXPERIMENT.pins, hidden=32)
    longer = dataclasses.replace(EXPERIMENT, pins=pins, train_pins=training)
    run_stages(longer, ("disentangled",), tmp_path, folder / "data", "none")
    rows = leakage.measure_leakage(longer, tmp_path / "toy", folder / "data", "none")["rows"]
    said = {row["name"]: row["families"]["linear"] for row in rows}
    assert read_slides(tmp_path / "toy" / "disentangled") == SLIDES
    assert said["slide_x_mm from z_s"] > 0.7 and said["slide_y_mm from z_s"] > 0.7
    assert said["x_mm from z_s"] < 0.1 and said["y_mm from z_s"] < 0.1


def read_last_line(place):
    return json.loads((place / "log.jsonl").read_text().splitlines()[-1])


def test_fewer_pairs_train_beside_taps(folder, tmp_path):
    """In a full training: taps, and slides of one pose, are terms of it, and of no validation.

    A short shear code is taught the first of the slides.
    """
    losses = {"supervised": 1.0, "slide": 1.0, "tap_identity": 0.5, "consistency": 0.5}
    training = dataclasses.replace(EXPERIMENT.train_pins, paired_share=0.1, losses=losses)
    pins = dataclasses.replace(EXPERIMENT.pins, shear_code=1)
    few = dataclasses.replace(EXPERIMENT, pins=pins, train_pins=training)
    run_stages(few, ("disentangled",), tmp_path, folder / "data", "none")
    place = tmp_path / "toy" / "disentangled"
    last = read_last_line(place)
    assert last["train"]["tap_identity"] > 0 and last["train"]["consistency"] > 0
    assert not {"tap_identity", "consistency"} & set(last["validation"])
    full = json.loads((folder / "runs" / "toy" / "disentangled" / "model.json").read_text())
    model = json.loads((place / "model.json").read_text())
    assert model["epoch_images"] == full["epoch_images"]
    assert read_slides(place) == SLIDES[:1]


def test_a_slide_is_felt_in_the_frame_of_the_sensor_and_its_twist_as_it_is():
    pose, move = np.array([[0, 0, 90.0, 2]]), np.array([[1.0, 0.0, -4.0]])
    np.testing.assert_allclose(to_sensor_frame(move, pose), [[0, -1, -4]], atol=1e-6)
    along = to_sensor_frame(move, pose)[:, :2]
    np.testing.assert_array_equal(to_sensor_frame(move[:, :2], pose), along)


def test_over_images_codes_that_are_apart_are_exchanged_too(folder, tmp_path):
    """Partners come with the batches, reconstructions are compared with images, z_s says the slide.

    End to end on the toy.
    """
    losses = {"counterfactual": 1.0, "code_agreement": 0.1, "slide": 1.0}
    training = Training(epochs=1, batch=8, crop_px=8, losses={**Training.losses, **losses})
    net = UnshearNet(
        size=SIZE, widths=(4, 4), pose_channels=4, shear_channels=2, separate_encoders=True
    )
    images = dataclasses.replace(EXPERIMENT, unshear=net, pins=PinNet(), train=training)
    run_stages(images, ("disentangled",), tmp_path, folder / "data", "none")
    run = tmp_path / "toy"
    last = read_last_line(run / "disentangled")
    assert losses.keys() <= set(last["train"]) and "slide" in last["validation"]
    assert read_slides(run / "disentangled") == SLIDES
    found = leakage.measure_leakage(images, run, folder / "data", "none", controls=False)
    assert found["sizes"] == {"z_p": 4, "z_s": 2}
    drawn = found["exchanged"]["drawn"]
    assert found["exchanged"]["ratio"] == pytest.approx(
        drawn["exchanged"]["rms_grey"] / drawn["both of its own"]["rms_grey"]
    )
    assert {"DS, codes exchanged", "DS, codes exchanged, sticking"} <= {
        row["name"] for row in leakage.build_sweep_rows(found)
    }
    assert "of 1 in grey" in leakage.format_table(found)
    exchanged = codes.exchange_codes(images, run, folder / "data")
    assert exchanged.decoded.shape == exchanged.true.shape == (2, 2, SIZE, SIZE, 1)
    assert set(np.unique(exchanged.true)) == {0, 1}
    assert 0 <= exchanged.decoded.min() <= exchanged.decoded.max() <= 1
    assert plot_leakage(found, exchanged)[:4] == b"\x89PNG"


def test_independence_says_whether_it_would_have_found_a_leak(found):
    assert {"x_mm and z_s", "slide_x_mm and z_p"} <= {row["name"] for row in found["independence"]}
    for row in found["independence"]:
        assert row["poses"] == 12 and 0 < row["p"] <= 1 and 0 < row["planted p"] <= 1


def test_a_planted_leak_is_found_by_the_test_of_independence():
    """A hundredth of the spread of a random code is planted: p is small with it alone."""
    rng = np.random.default_rng(5)
    code, quantity = rng.normal(size=(400, 8)), rng.uniform(-1, 1, (400, 1))
    quantities = {("slide", "slide_x_mm"): quantity}
    test = probe_data.ProbeSplit({"z_p": code}, quantities, np.arange(400), {})
    row = {"leak": True, "ceiling": 0.9, "code": "z_p", "what": "slide", "quantity": "slide_x_mm"}
    (tested,) = leakage.measure_independence(test, [row])
    assert tested["p"] > 0.05 and tested["planted p"] < 0.01
