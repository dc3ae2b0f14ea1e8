"""The stage on files: networks on disk and a stand-in data set in, results and montage out."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from jaxunshear.config.data import PairedData
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.network_config import resolve_network
from jaxunshear.config.networks import ALL_NETWORKS, UNSHEARING
from jaxunshear.config.sensor import TACTIP_331, Preprocess
from jaxunshear.data import stored_sets
from jaxunshear.data.sources import open_source
from jaxunshear.errors import UserError
from jaxunshear.evaluation import simulated_evaluation
from jaxunshear.evaluation.contact_scores import QUALITY
from jaxunshear.evaluation.evaluate import evaluate
from jaxunshear.evaluation.score import BASELINES
from jaxunshear.files import read_json, to_builtins, write_json
from jaxunshear.results.record_files import SCHEMA, read_record
from jaxunshear.results.run import Results
from tests.helpers.reproducible import select_results

SIZE, COUNT = 32, 6


class Reader:
    """Stands in for the reader of `tactip_paired`: random dots and labels."""

    metadata = {"counts": {"contacts": 99, "retried": 2, "dropped": 1}}  # noqa: RUF012

    def __init__(self, count):
        self.count = count

    def length(self, split):
        return {"train": 18, "validation": 6, "test": self.count}[split]

    def take(self, split, rows, fields):
        """Of the taps of the pose set."""
        assert split == "train"  # whoever learns from them sees no other
        count = self.length(split)
        full = next(self.split(split, count, ("canonical", "pose", "edge")))
        pins = np.random.default_rng(1).normal(SIZE / 2, 5, (count, TACTIP_331.pins, 2))
        full |= {"image": full["canonical"], "pins": pins}
        return {field: full[field][rows] for field in fields}

    def split(self, name, batch, fields):
        generator, count = np.random.default_rng(0), self.length(name)
        images = np.where(generator.random((2, count, SIZE, SIZE, 1)) < 0.2, 255, 0).astype(
            np.uint8
        )
        across = np.arange(8, 24, 4, dtype=np.float32)
        pins = np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2)
        full = {
            "canonical": images[0],
            "sheared": images[1],
            "canonical_pins": np.stack([pins] * count),
            "sheared_pins": np.stack([pins + 1] * count),
            "stimulus": np.arange(count) % 2,
            "pose_id": np.arange(count),
            "pose": generator.normal(size=(count, 4)).astype(np.float32),
            "edge": generator.normal(size=(count, 2)).astype(np.float32),
            "move": np.ones((count, 2), np.float32),
            **dict.fromkeys(QUALITY, np.ones(count)),
        }
        for start in range(0, count, batch):
            yield {field: full[field][start : start + batch] for field in fields}


def _opens(monkeypatch, count):
    for module in (simulated_evaluation, stored_sets):
        monkeypatch.setattr(module, "open_set", lambda *_: Reader(count))
    monkeypatch.setattr(simulated_evaluation, "read_metadata", lambda *_: Reader.metadata)


@pytest.fixture
def experiment():
    paired = PairedData(preprocess=Preprocess(size=SIZE))
    return Experiment(name="small", claim="that the stage works", paired=paired)


@pytest.fixture
def run_dir(trained, experiment, tmp_path, monkeypatch):
    """The networks as if they had learnt from the data sets of `experiment`."""
    _opens(monkeypatch, COUNT)
    folder = shutil.copytree(trained, tmp_path / "run")
    for network in ALL_NETWORKS:
        path, config = folder / network / "model.json", resolve_network(experiment, network)
        origin = open_source(experiment).describe_origin(config)
        write_json(path, read_json(path) | {"origin": origin})
    return folder


def test_evaluate_writes_what_it_returns_and_the_same_again(run_dir, experiment, tmp_path):
    (run_dir / "times.json").write_text(json.dumps({"data": 12.5}))
    results = evaluate(experiment, run_dir, tmp_path / "data", "jaxunshear evaluate x.py")
    assert read_json(run_dir / "results.json") == {"schema": SCHEMA} | to_builtins(results)
    assert read_record(run_dir / "results.json", Results, "again") == results
    assert results.metric["ms_ssim"] == "ms_ssim@2"
    assert results.time_s["data"] == 12.5
    assert results.time_s["evaluate"] > 0
    assert results.counts.test == COUNT
    assert set(results.ms_per_image) == set(experiment.networks)
    assert all(0 < times["median"] <= times["p95"] for times in results.ms_per_image.values())
    assert results.counts.dropped == 1
    assert results.counts.reader_taps == {"pixels": 18, "pins": 18}
    assert set(results.readers["pixels"]) == {"tap", "sheared", "entangled", "disentangled"}
    assert results.readers["pixels"]["disentangled"]["edge_mm"] > 0
    assert results.reader_images["pixels"]["tap"] == {"read": COUNT, "left_out": 0}
    none = {"read": 0, "left_out": COUNT}
    assert results.reader_images["pins"]["tap"] == none  # random dots are no pins
    assert results.readers["pins"]["tap"]["edge_mm"] is None
    assert results.ms_ssim["disentangled"]["teardrop"] is None
    for name in (
        *("ms_ssim", "pose_mae", "swap", "pin_error", "spread", "machine", "versions"),
        *("source", "seeds", "command", "paper"),
    ):
        assert getattr(results, name), name
    montage = (run_dir / "montage.npz").read_bytes()
    again = evaluate(experiment, run_dir, tmp_path / "data", "jaxunshear evaluate x.py")
    assert select_results(again) == select_results(results)
    assert list(results.ms_ssim) == ["sheared", *BASELINES, "entangled", "disentangled"]
    assert (run_dir / "montage.npz").read_bytes() == montage


def test_evaluate_scores_further_tests_with_all_of_their_splits(run_dir, experiment, tmp_path):
    tests = {"unseen": ("flower", "leaf"), "other_jitters_mm": (0.5,), "other_twists_deg": (5.0,)}
    further = replace(experiment, networks=ALL_NETWORKS, **tests)
    results = evaluate(further, run_dir, tmp_path / "data", "jaxunshear evaluate x.py")
    assert list(results.tests) == ["unseen", "depth_0.5mm", "twist_5deg"]
    assert [test.ranges["twist_deg"] for test in results.tests.values()] == [0, 0, 5]
    test = results.tests["unseen"]
    assert test.contacts == 18 + 6 + COUNT
    assert test.ms_ssim["unet"]["leaf"] > 0
    assert test.pose_mae["sheared_learnt"]["edge_mm"] > 0
    assert list(test.readers) == ["pixels"]
    assert set(test.readers["pixels"]) == {"tap", "sheared", *UNSHEARING}
    assert (run_dir / "scores-unseen.npz").exists()


def test_an_empty_test_split_is_refused(run_dir, experiment, tmp_path, monkeypatch):
    _opens(monkeypatch, 0)
    with pytest.raises(UserError, match="empty"):
        evaluate(experiment, run_dir, tmp_path / "data", "jaxunshear evaluate x.py")
    assert not (run_dir / "results.json").exists()


@pytest.mark.parametrize(
    ("summary", "message"),
    [
        ("{", r"posenet.summary.json"),
        (None, r"posenet was not finished: .*`jaxunshear train FILE --network posenet --out"),
    ],
)
def test_a_damaged_or_half_trained_network_is_not_scored(
    run_dir, experiment, tmp_path, summary, message
):
    path = run_dir / "posenet" / "summary.json"
    path.write_text(summary) if summary else path.unlink()
    with pytest.raises(UserError, match=message):
        evaluate(experiment, run_dir, tmp_path / "data", "jaxunshear evaluate x.py")
    assert not (run_dir / "results.json").exists()
