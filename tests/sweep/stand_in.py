"""A worker with made-up networks, data sets and evaluation, called like sweep/worker.py.

`python stand_in.py FOLDER PARENT` does one task; `python stand_in.py sweep OUT [ray|retry]` runs a
sweep of such workers, for a test to kill. A training takes ten steps of `STAND_IN_PAUSE` seconds
with a checkpoint each, and writes a line for every step to <data>/steps.txt. Learning rates of 1/2,
1/4 and 1/8 make it fail; 1/16 finds the disk full if `STAND_IN_FULL` is set.
"""

import errno
import json
import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxunshear.code_version import read_source
from jaxunshear.config.configs import describe_set
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.network_config import resolve_network
from jaxunshear.config.networks import TRAINABLE
from jaxunshear.config.serialization import to_json
from jaxunshear.config.sweep import Sweep
from jaxunshear.errors import UserError
from jaxunshear.files import explain_os_error, read_json, to_builtins, write_json
from jaxunshear.results.measurement import TrainingSummary
from jaxunshear.results.record_files import convert_record
from jaxunshear.results.run import Results
from jaxunshear.results.sweep import Outcome
from jaxunshear.sweep import worker
from jaxunshear.sweep.grid import format_training_name

WORKER = (sys.executable, str(Path(__file__).resolve()))
STEPS = 10
CONTACTS, SLIDES = 24, 2
TRAINED_BY = {"version": "0", "date": "2000-01-01"}
BASE = Experiment(name="small", claim="none", networks=("disentangled", "posenet"))
SWEEP = Sweep(
    name="small",
    claim="none",
    base=BASE,
    grid=(
        ("train.losses.patch", (0.0, 0.1)),
        (("unshear.pose_channels", "unshear.shear_channels"), ((8, 120), (128, 128))),
    ),
    seeds=(0, 1),
    ablation=True,
)


def run_stages(experiment, stages, out, data, command):
    folder = Path(out) / experiment.name
    write_json(folder / "experiment.json", to_json(experiment))
    results = None
    for stage in stages:
        if stage in TRAINABLE:
            train(experiment, stage, folder, Path(data))
        elif stage == "evaluate":
            results = evaluate(experiment, folder)
    return results


def train(experiment, network, folder, data):
    place = folder / network
    if (place / "summary.json").exists():
        return
    place.mkdir(exist_ok=True)
    config = resolve_network(experiment, network)
    write_json(place / "model.json", {"origin": describe_set(config.source, config.sensor)})
    part = format_training_name(config)
    checkpoint = place / "checkpoint.json"
    state = {"step": 0, "value": int(part[-8:], 16)}
    if checkpoint.exists():
        state = read_json(checkpoint)
    while state["step"] < STEPS:
        time.sleep(float(os.environ.get("STAND_IN_PAUSE", "0")))
        with (data / "steps.txt").open("a") as steps:
            steps.write(f"{part} {state['step']}\n")
        if state["step"] == STEPS // 2 and network == "disentangled":
            fail(experiment.train.learning_rate, place)
        state = {"step": state["step"] + 1, "value": (state["value"] * 48271 + 11) % 2147483647}
        write_json(checkpoint, state)
    seconds = time.process_time()
    record = TrainingSummary(
        steps=STEPS, parameters=1, best_step=STEPS, train_seconds=seconds, images_per_second=100.0
    )
    write_json(place / "summary.json", state | to_builtins(record))


def check_checkpoints(source):
    if not (source / "checkpoint.json").exists():
        raise UserError(
            f"{source} has lost its checkpoints: delete that folder, then run the same command"
        )


def load_best(source):
    return read_json(source / "checkpoint.json")


def fail(learning_rate, place):
    if learning_rate == 1 / 2:
        raise UserError(f"training {place} stopped: supervised not finite at step 5")
    if learning_rate == 1 / 4:
        os.kill(os.getpid(), signal.SIGKILL)
    if learning_rate == 1 / 16 and "STAND_IN_FULL" in os.environ:
        error = OSError(errno.ENOSPC, "No space left on device")
        raise explain_os_error(place, error) from error
    if learning_rate == 1 / 8:
        raise ZeroDivisionError("a bug\nof two lines")


def evaluate(experiment, folder):
    values = [
        read_json(folder / network / "summary.json")["value"] for network in experiment.networks
    ]
    random = np.random.default_rng(values)
    names = ("ms_ssim/disentangled", "pose/disentangled/edge_mm", "swap/DS(z_p,z_s)/mse")
    scores = {name: random.random(CONTACTS) for name in names}
    pose = np.arange(CONTACTS) // SLIDES
    np.savez(folder / "scores.npz", **scores, stimulus=pose % 3, pose_id=pose)
    found = {
        "metric": {"ms_ssim": "ms_ssim@4"},
        "settings": to_json(experiment),
        "tests": {},
        "pin_error": {"disentangled": {"rms_px": float(random.random())}},
        "ms_per_image": {name: {"median": 1.0, "p95": 2.0} for name in experiment.networks},
        "machine": {"device": "none"},
        "versions": {"jaxunshear": "0"},
        "source": read_source(),
        "trained_by": dict.fromkeys(experiment.networks, TRAINED_BY),
    }
    return convert_record(to_builtins(found), Results, "made up", "again")


def ablate(experiment, folder, data, command):
    value = read_json(folder / "disentangled" / "summary.json")["value"]
    row = {"name": "DS(z_p,0)", "target": "sheared", "paper": None, "ssim": value / 2**31}
    return {"rows": [row | {"ssim interval": [0, 1]}]}


def measure_leakage(experiment, folder, data, command, controls):
    return read_json(folder / "disentangled" / "summary.json")["value"] / 2**31


def build_sweep_rows(found):
    return [{"name": "slide from z_p", "r2": found}]


def main():
    if sys.argv[1] == "sweep":
        from jaxunshear.cluster import make_ray_runner
        from jaxunshear.sweep.run import run_sweep

        out = Path(sys.argv[2])
        (out / "data").mkdir(parents=True, exist_ok=True)
        failing = replace(SWEEP, grid=SWEEP.grid[:1], rows=((("train.learning_rate", 0.5),),))
        more = {"run_calls": make_ray_runner(None, 1)} if sys.argv[3:] == ["ray"] else {}
        retry = sys.argv[3:] == ["retry"]
        summary = run_sweep(
            failing, out, out / "data", "none", retry_failed=retry, worker=WORKER, **more
        )
        print(json.dumps(to_builtins(summary)))
        return 0
    for name, functions in {
        "evaluation.code_swaps": [ablate],
        "evaluation.leakage": [measure_leakage, build_sweep_rows],
        "training.checkpoint": [check_checkpoints, load_best],
    }.items():
        module = sys.modules[f"jaxunshear.{name}"] = type(sys)(name)
        vars(module).update({function.__name__: function for function in functions})
    worker.keep_freed_memory = lambda: None  # would import JAX
    worker.run_stages = run_stages
    worker._make_data = lambda order, folder: Outcome(status="done", reason=None)
    return worker.main(Path(sys.argv[1]), int(sys.argv[2]))


if __name__ == "__main__":
    sys.exit(main())
