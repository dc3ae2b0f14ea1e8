"""Weights that may know what is tested are refused by name, before anything is made."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from jaxunshear.errors import UserError
from jaxunshear.run import run_stages
from jaxunshear.settings.configs import VERSION, describe
from jaxunshear.settings.data import PairedData, PoseData, Recorded, RecordedTaps
from jaxunshear.settings.experiment import Experiment
from jaxunshear.settings.sensor import TACTIP_331
from jaxunshear.settings.stored import to_json
from jaxunshear.storage import write_json
from jaxunshear.training.kept_out import Exam, exams_of, known
from jaxunshear.training.origin import check_kept_out, check_origin, origin_of, origins_of, taken_over

WEIGHTS = Path(__file__).resolve().parents[2] / "jaxunshear" / "weights"
SIMULATED = Experiment(name="small", claim="none", networks=("disentangled", "posenet"))
RECORDED = Experiment(name="skin", claim="none", paired=Recorded(digest="aa+bb"), pose=RecordedTaps())


def origin(settings, version=None):
    described = describe(settings, TACTIP_331)
    return described | {"version": version or described["version"]}


@pytest.mark.parametrize(
    ("learnt", "version", "tested", "line"),
    [
        (PairedData(poses=9000), "2.4.0", Exam(PairedData()), "paired 2.4.0 of seed 0 (9000 poses"),
        (PairedData(), "2.4.0", Exam(PairedData()), "another --paired.seed, or weights of data version 3.0.0"),
        (PairedData(poses=9000), None, Exam(PairedData()), ""),  # both split by the pose
        (PairedData(), "10.0.0", Exam(PairedData()), ""),
        (PairedData(seed=7), "2.4.0", Exam(PairedData()), ""),  # other poses
        (PairedData(stimuli=("leaf",)), "2.4.0", Exam(PairedData()), ""),
        (PoseData(seed=0), "2.4.0", Exam(PairedData()), "learnt from tactip_pose"),  # taps of the same poses
        (PoseData(seed=0), None, Exam(PairedData()), ""),
        (PairedData(), None, Exam(PairedData(), entire=True), "all of tactip_paired"),
        (PairedData(), None, Exam(PairedData(stimuli=("leaf",)), True), ""),
        (PairedData(stimuli=("disk", "leaf"), seed=7), None, Exam(PairedData(stimuli=("leaf",)), True, True), "leaf"),
        (PairedData(), "2.4.0", Exam(Recorded(digest="aa")), ""),
        (Recorded(digest="aa"), None, Exam(PairedData()), ""),
        (Recorded(digest="aa"), None, Exam(Recorded(digest="aa")), ""),
        (Recorded(digest="aa", labelled=0.1), None, Exam(Recorded(digest="aa+bb")), ""),  # other taps beside
        (Recorded(digest="aa", seed=1), None, Exam(Recorded(digest="aa")), "digest aa), split with paired.seed 1"),
        (Recorded(digest="aa", test=0.2), None, Exam(Recorded(digest="bb+aa")), "paired.test 0.2"),
        (Recorded(digest="aa", validation=0.2), None, Exam(Recorded(digest="aa")), "paired.validation 0.2"),
        (Recorded(digest="aa", split="block"), None, Exam(Recorded(digest="aa")), "split with paired.split block"),
        (Recorded(digest="aa"), None, Exam(Recorded(digest="aa", split="block")), "split with paired.split random"),
        (Recorded(digest="aa+pcc"), None, Exam(Recorded(digest="aa")), "another table of pairs"),
        (Recorded(digest="aa"), "0.9.0", Exam(Recorded(digest="aa")), "data version 0.9.0"),
        (Recorded(digest="aa", seed=1), None, Exam(Recorded(digest="bb")), ""),  # nobody can know
        (Recorded(digest="aa+bb"), None, Exam(Recorded(digest="bb"), entire=True), "digest bb"),
        (Recorded(digest="aa"), None, Exam(Recorded(digest="bb"), entire=True), ""),
    ],
)
def test_what_weights_may_know_is_reported_by_their_origin(learnt, version, tested, line):
    reason = known(origin(learnt, version), tested)
    assert line in reason and bool(reason) == bool(line)


def test_further_tests_are_of_full_sets():
    experiment = replace(SIMULATED, unseen=("leaf",), other_jitters_mm=(1.0,))
    assert [(t.settings.seed, t.entire, t.new_shapes) for t in exams_of(experiment)] == [
        (0, False, False),
        (1000, True, True),
        (1000, True, False),
    ]


def weights(folder, experiment, network, begin=None, version=None):
    """model.json as a training writes it."""
    more = {"taken_over": taken_over(experiment, network, folder, begin), **({"start": "x"} if begin else {})}
    own = origin_of(experiment, network)
    write_json(folder / network / "model.json", {"origin": own | {"version": version or own["version"]}, **more})
    return folder / network


def test_two_starts_launder_nothing(tmp_path):
    """old, seed 0 -> between, seed 7 -> last, seed 8: the last still knows seed 0."""
    old = weights(tmp_path / "old", SIMULATED, "disentangled", version="2.4.0")
    for name, seed, begin in (("between", 7, old), ("last", 8, tmp_path / "between" / "disentangled")):
        experiment = replace(SIMULATED, paired=PairedData(seed=seed))
        check_kept_out(begin, exams_of(experiment))
        last = weights(tmp_path / name, experiment, "disentangled", begin)
        check_origin(experiment, "disentangled", tmp_path / name)
    assert [each["settings"]["seed"] for each in origins_of(last)] == [8, 7, 0]
    with pytest.raises(UserError, match=r"last/disentangled learnt from tactip_paired 2\.4\.0 of seed 0"):
        check_kept_out(last, exams_of(SIMULATED))


def test_a_teacher_s_taps_come_along(tmp_path):
    taught = replace(SIMULATED, train=replace(SIMULATED.train, pose_weight=0.5))
    weights(tmp_path, taught, "posenet_teacher")
    network = weights(tmp_path, taught, "disentangled")
    assert [each["set"] for each in origins_of(network)] == ["tactip_paired", "tactip_pose"]
    further = replace(SIMULATED, paired=PairedData(seed=1), pose=PoseData(seed=5))
    check_kept_out(network, exams_of(further))
    write_json(tmp_path / "posenet_teacher" / "model.json", {"origin": origin(PoseData(), "2.4.0"), "taken_over": []})
    with pytest.raises(UserError, match=r"tactip_pose 2\.4\.0 of seed 1"):
        check_kept_out(weights(tmp_path, taught, "disentangled"), exams_of(further))


def test_a_finished_network_that_took_over_its_test_is_not_scored(tmp_path):
    old = weights(tmp_path / "old", replace(SIMULATED, paired=PairedData(poses=50)), "disentangled", version="2.4.0")
    weights(tmp_path / "run", SIMULATED, "disentangled", begin=old)
    with pytest.raises(UserError, match="50 poses a shape"):
        check_origin(SIMULATED, "disentangled", tmp_path / "run")


def test_recordings_split_anew_are_refused_and_a_run_s_own_helpers_add_nothing(tmp_path):
    for helper in ("renderer", "disentangled"):
        network = weights(tmp_path, RECORDED, helper)
    assert origins_of(network) == [origin_of(RECORDED, "disentangled")]
    check_kept_out(network, exams_of(RECORDED))
    other = replace(RECORDED, paired=replace(RECORDED.paired, seed=3))
    with pytest.raises(UserError, match=r"digest aa, bb.*split with paired\.seed 0: split them alike"):
        check_kept_out(network, exams_of(other))


def test_weights_of_earlier_versions_count_with_all_that_they_may_have_seen(tmp_path):
    folder = tmp_path / "posenet"
    write_json(folder / "model.json", {"kind": "posenet"})
    with pytest.raises(UserError, match="does not say what it learnt from"):
        origins_of(folder)
    write_json(tmp_path / "experiment.json", to_json(SIMULATED))
    assert [each["settings"]["seed"] for each in origins_of(folder)] == [0, 1]
    with pytest.raises(UserError, match=r"before 3\.0\.0 of seed 0"):
        check_kept_out(folder, exams_of(SIMULATED))
    check_kept_out(folder, exams_of(replace(SIMULATED, paired=PairedData(seed=7))))
    write_json(tmp_path / "experiment.json", to_json(RECORDED))
    with pytest.raises(UserError, match="recordings that are tested"):
        check_kept_out(folder, [Exam(replace(RECORDED.paired, digest="bb"), entire=True)])
    started = replace(SIMULATED, train=replace(SIMULATED.train, start="somewhere"))
    write_json(tmp_path / "experiment.json", to_json(started))
    with pytest.raises(UserError, match="began from weights whose data it does not name"):
        origins_of(folder)


def test_released_weights_give_their_origin(tmp_path):
    """Those of today's data keep out what every set of their seed keeps out; those of an earlier version do not."""
    standard = WEIGHTS / "standard"
    for model in standard.glob("*/model.json"):
        origins = origins_of(model.parent)
        assert {each["version"] for each in origins} == {VERSION}
        assert {each["settings"]["seed"] for each in origins} <= {0, 1}
        check_kept_out(model.parent, exams_of(SIMULATED))
    older = tmp_path / "older"
    shutil.copytree(standard, older)
    for model in older.glob("*/model.json"):
        write_json(model, json.loads(model.read_text().replace(VERSION, "2.4.0")))
    started = replace(SIMULATED, train=replace(SIMULATED.train, start=str(older)))
    with pytest.raises(UserError, match=r"older/disentangled learnt from tactip_paired 2\.4\.0 of seed 0"):
        run_stages(
            started, ("data", "disentangled", "posenet", "evaluate"), tmp_path / "runs", tmp_path / "data", "none"
        )
    assert [path.name for path in tmp_path.iterdir()] == ["older"]
    check_kept_out(older / "disentangled", exams_of(replace(started, paired=PairedData(seed=7))))
