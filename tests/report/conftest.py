"""A finished run made up of formulas: every file that the report reads, none of the work."""

import itertools
import json
import shutil
from html.parser import HTMLParser

import numpy as np
import pytest

from jaxunshear.config.experiment import Experiment
from jaxunshear.evaluation.contact_scores import ContactScores
from jaxunshear.evaluation.evaluate import collect_montage
from jaxunshear.evaluation.score import CELL_METRICS, CELLS
from jaxunshear.evaluation.simulated_evaluation import build_simulated_results
from jaxunshear.files import to_builtins
from jaxunshear.report.report import write_report

VOID = {"meta", "img", "br"}
SIZE, COUNT = 128, 36
POSE = {"tap": 0.1, "sheared": 1.2, "entangled": 0.5, "disentangled": 0.35}
SCALE = {"x_mm": 2.0, "yaw_deg": 14.0, "edge_mm": 2.0, "edge_deg": 20.0}
LIKENESS = {"sheared": 0.31, "entangled": 0.91, "disentangled": 0.94}


def dots(slide, soft=False, lost=0.0):
    """Draw 331 dots in rings, pushed outwards and then along `slide`, most in the middle.

    Returns the image and the centres (P, 2) in px.
    """
    rings = [(0.0, 1)] + [(ring * 5.4, 6 * ring) for ring in range(1, 11)]
    turns = [radius * np.exp(2j * np.pi * np.arange(count) / count) for radius, count in rings]
    pins = np.concatenate(turns).view(float).reshape(-1, 2)
    near = np.exp(-((pins[:, :1] - 8) ** 2 + pins[:, 1:] ** 2) / 900)
    pins = 63.5 + pins * (1 + 0.12 * near) + near * np.asarray(slide)
    rows, columns = np.mgrid[:SIZE, :SIZE]
    away = np.hypot(columns[..., None] - pins[:, 0], rows[..., None] - pins[:, 1]).min(axis=-1)
    grey = 1 / (1 + np.exp((away - 1.5) * (2 if soft else 20))) * (1 - lost * (columns > 80))
    return np.rint(grey * 255).astype(np.uint8), pins.astype(np.float32)


def made_up_gathered():
    generator = np.random.default_rng(0)
    stimulus, pose_id = np.arange(COUNT) % 3, np.arange(COUNT) // 6

    def spread(mean, size):
        drawn = mean + size * generator.normal(size=COUNT)
        return np.clip(drawn, 0, None).astype(np.float32)

    kept = np.arange(0, COUNT, 4)
    scores, read = {}, {}
    for kind, mean in LIKENESS.items():
        scores[f"ms_ssim/{kind}"] = np.minimum(spread(mean, 0.04), 1)
    for kind, name in itertools.product(POSE, SCALE):
        error = spread(POSE[kind] * SCALE[name], 0.1 * SCALE[name])
        scores |= {f"pose/{kind}/{name}": error, f"read/pixels/{kind}/{name}": 2 * error}
        read[f"read/pins/{kind}/{name}"] = 3 * error[kept]
    for name in SCALE:
        read[f"read/pins/sheared/{name}"][1] = np.nan
    for cell, metric in itertools.product(CELLS, CELL_METRICS):
        scores[f"swap/{cell}/{metric}"] = spread(0.2, 0.05)
    tap, slide = dots((0, 0)), dots((6, 4))
    pictures = {"tap": tap[0], "sheared": slide[0]}
    pictures["entangled"] = dots((1.2, 0), soft=True, lost=0.3)[0]
    pictures["disentangled"] = dots((0.4, 0), soft=True)[0]
    pins = {"canonical_pins": tap, "sheared_pins": slide}
    labels = {
        "stimulus": stimulus,
        "pose_id": pose_id,
        "pose": generator.uniform(1, 5, (COUNT, 4)).astype(np.float32),
        "edge": generator.uniform(-5, 5, (COUNT, 2)).astype(np.float32),
        "move": generator.uniform(-2.5, 2.5, (COUNT, 2)).astype(np.float32),
        "residual_mm": generator.uniform(0, 1e-3, COUNT),
    }
    for name in ("iterations", "stuck", "slipping", "free"):
        labels[name] = generator.integers(5, 90, COUNT)
    return ContactScores(
        scores,
        labels,
        kept,
        {kind: np.stack([image] * len(kept)) for kind, image in pictures.items()},
        {name: np.stack([drawn[1]] * len(kept)) for name, drawn in pins.items()},
        read,
    )


def make_run(folder):
    """Writes the made-up run into `folder`; returns its results."""
    gathered = made_up_gathered()
    claim = "Nothing was measured: <b>numbers & images</b> are from formulas."
    experiment = Experiment(name="made up", claim=claim)
    results = to_builtins(build_simulated_results(experiment, gathered)) | {
        "ms_per_image": {"disentangled": {"median": 4.2, "p95": 5.1}},
        "time_s": {"data": 131.2, "disentangled": 182.9},
        "machine": {"processor": "none", "cores": 2, "device": "cpu: cpu"},
        "versions": {"python": "3.11.7", "jax": "0.10.1"},
        "command": "jaxunshear run experiments/demo.py",
    }
    results["counts"] |= {"train": 2160, "validation": 720, "test": 720}
    results["counts"] |= {"contacts": 5400, "retried": 3, "dropped": 1}
    results["counts"]["reader_taps"] = {"pixels": 3000, "pins": 2999}
    (folder / "results.json").write_text(json.dumps(results))
    np.savez(folder / "montage.npz", **collect_montage(experiment.paired.stimuli, gathered))
    later = {"entangled": 96.4, "posenet": 54.0, "evaluate": 31.7, "report": 2.1}
    (folder / "times.json").write_text(json.dumps(results["time_s"] | later))
    for network, terms in (
        ("disentangled", ("supervised", "reconstruction")),
        ("entangled", ("supervised",)),
        ("posenet", ("pose", "edge_mm", "edge_deg")),
    ):
        (folder / network).mkdir()
        lines = []
        for step in range(100, 900, 100):
            line = {"epoch": step / 135, "train_seconds": step * 0.21}
            loss = 0.15 * (100 / step) ** 0.8
            line["validation"] = {name: (1 + i) * loss for i, name in enumerate(terms)}
            line["train"] = {terms[0]: 0.9 * loss, "gradient": 1}
            lines.append(json.dumps(line))
        (folder / network / "log.jsonl").write_text("\n".join(lines) + "\n")
        summary = {"parameters": 415000, "steps": 800, "best_step": 800}
        summary |= {"images_per_second": 76.2, "train_seconds": 168.0}
        (folder / network / "summary.json").write_text(json.dumps(summary))
    return results


@pytest.fixture(scope="session")
def template(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made_up")
    make_run(folder)
    return folder


@pytest.fixture
def made_up_run(template, tmp_path):
    """A copy of the run for each test to spoil: its folder and its results."""
    folder = shutil.copytree(template, tmp_path / "run")
    return folder, json.loads((folder / "results.json").read_text())


class Reader(HTMLParser):
    """Checks that tags close in order, and collects addresses and text."""

    def __init__(self):
        super().__init__()
        self.open, self.addresses, self.text = [], [], []

    def handle_starttag(self, tag, attrs):
        self.addresses += [value for name, value in attrs if name in ("src", "href", "srcset")]
        assert tag not in ("script", "link", "iframe")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "nav" not in self.open:  # the contents have the headings once more
            self.text.append(data)


@pytest.fixture(scope="session")
def read():
    def read(html):
        reader = Reader()
        reader.feed(html)
        assert not reader.open
        return reader

    return read


@pytest.fixture(scope="session")
def read_page(read):
    """The text of a page, single spaces between its words."""
    return lambda path: " ".join(" ".join(read(path.read_text()).text).split())


@pytest.fixture(scope="session")
def read_report(read_page):
    """`read_report(folder, results)` writes the report, of these results if given; its text."""

    def read_report(folder, results=None):
        if results is not None:
            (folder / "results.json").write_text(json.dumps(results))
        return read_page(write_report(folder))

    return read_report
