"""benchmarks/gpu.sh without a GPU: its commands parse, failures are reported, steps summed up."""

import json
import os
import shlex
import shutil
import subprocess
from dataclasses import asdict
from pathlib import Path

import pytest

from benchmarks import commands, gpu_summary
from jaxunshear import cli
from jaxunshear.config.network_config import list_trained_networks
from jaxunshear.config.rules import validate
from jaxunshear.results.sweep import CellResult, Costs

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "benchmarks" / "gpu.sh"
STEPS = ("install", "check", "train", "infer", "frame", "sim", "seeds", "paper")
FAKES = ("python", "python3", "jaxunshear", "nvidia-smi")


@pytest.fixture
def gpu(tmp_path):
    """Return `gpu(*words)`: a copy of the script, whose programs only write down their words.

    A program fails if $FAILS is among its words.
    """
    folder, programs = tmp_path / "clone" / "benchmarks", tmp_path / "programs"
    folder.mkdir(parents=True)
    programs.mkdir()
    shutil.copy(SCRIPT, folder)
    for name in FAKES:
        fake = programs / name
        fake.write_text(
            f'#!/bin/sh\necho "{name} $*" >>"{tmp_path}/calls"\n'
            'case " $* " in *" ${FAILS:-nothing} "*) exit 3 ;; esac\n'
        )
        fake.chmod(0o755)

    def call(*words, **variables):
        path = f"{programs}{os.pathsep}{os.environ['PATH']}"
        environment = {"PATH": path, "OUT": str(tmp_path / "out"), **variables}
        answer = subprocess.run(
            ["bash", folder / SCRIPT.name, *words], env=environment, capture_output=True, text=True
        )
        calls = tmp_path / "calls"
        return answer, calls.read_text().splitlines() if calls.exists() else []

    return call


def list_steps(text):
    """List the commands of a dry run by the names of their steps."""
    return {name: shlex.split(words) for name, words in (x.split(":", 1) for x in text)}


def test_bash_parses_it():
    assert subprocess.run(["bash", "-n", SCRIPT], capture_output=True, text=True).stderr == ""


def test_a_dry_run_lists_every_part_and_does_nothing(gpu, tmp_path):
    answer, calls = gpu("--dry-run")
    names = [line.partition(":")[0] for line in answer.stdout.splitlines()]
    assert answer.returncode == 0 and not answer.stderr
    assert all(any(name.startswith(part) for name in names) for part in STEPS)
    assert all(call.startswith("nvidia-smi") for call in calls)
    assert not (tmp_path / "clone" / "runs").exists()
    check, frame = gpu("--dry-run", "frame")[0].stdout.splitlines()
    assert check.startswith("check: ") and frame.startswith("frame: ")


def test_every_command_parses(gpu):
    known = 0
    for words in list_steps(gpu("--dry-run")[0].stdout.splitlines()).values():
        if words[0] == "xargs":
            words = [word.replace("{}", "0") for word in words[words.index("jaxunshear") :]]
        if words[0] == "jaxunshear":
            words[2] = str(ROOT / words[2])
            experiment = cli.read_base(words[1:])
            validate(experiment)
            if "--network" in words:
                assert words[words.index("--network") + 1] in list_trained_networks(experiment)
        elif words[:3] == ["python", "-m", "benchmarks"]:
            commands.make_parser().parse_args(words[3:])
        else:
            continue
        known += 1
    assert known == 13


def test_a_failing_part_is_reported_and_later_ones_run(gpu, tmp_path):
    answer, calls = gpu("train", "infer", "frame", FAILS="infer")
    assert answer.returncode == 1
    assert answer.stderr == "failed: infer: exit code 3; see runs/gpu/infer.log\n"
    started = [call.split()[3] for call in calls if call.startswith("python -m benchmarks ")]
    assert started == ["train", "infer", "frame"]
    assert calls[-1] == "python -m benchmarks.gpu_summary runs/gpu"
    steps = {row["name"]: row["exit_code"] for row in gpu_summary.read_steps(tmp_path / "out")}
    assert steps == {"check": 0, "train": 0, "infer": 3, "frame": 0}


def test_without_a_gpu_the_rest_is_left_out(gpu):
    fails = 'import jax; print(jax.devices("gpu"))'
    answer, calls = gpu("train", FAILS=fails)
    assert answer.returncode == 1 and "install an NVIDIA driver" in answer.stderr
    assert not any("benchmarks train" in call for call in calls)


def test_two_seeds_are_started_by_one_and_by_two(gpu, tmp_path):
    answer, calls = gpu("seeds")
    assert answer.returncode == 0, answer.stderr
    names = sorted(call.split("--name ")[1].split()[0] for call in calls if "--name" in call)
    assert names == ["by_1_0", "by_1_1", "by_2_0", "by_2_1", "first"]


def test_no_step_starts_after_the_time_limit(gpu):
    answer, calls = gpu("install", MINUTES="0")
    assert answer.returncode == 1 and "venv: no time is left" in answer.stderr
    assert not any("venv" in call for call in calls)


def test_an_unknown_part_is_refused(gpu):
    answer, _ = gpu("trains")
    assert answer.returncode == 2 and "PART = trains: must be one of install" in answer.stderr


def test_a_summary_has_the_last_time_of_each_step_and_the_gain(tmp_path, capsys):
    lines = ("train\t90\t1", "seeds_by_1\t120\t0", "seeds_by_2\t80\t0", "train\t100\t0")
    (tmp_path / "steps.tsv").write_text("\n".join(lines) + "\n")
    for workers, seconds in ((1, (20, 22)), (2, (30, 28))):
        for seed, train_s in enumerate(seconds):
            costs = Costs(train_seconds={"disentangled": train_s})
            cell = CellResult(label="base", point=(), costs={str(seed): costs})
            content = {"cells": [asdict(cell)]}
            (tmp_path / f"seed_by_{workers}_{seed}.json").write_text(json.dumps(content))
    gpu_summary.main(tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["rows"][0] == {"name": "train", "s": 100, "exit_code": 0}
    assert summary["side_by_side"] == {"commands": 1.5, "trainings": 1.4}
    assert {"source", "machine", "versions", "gpu"} <= summary.keys()
    assert "1.40" in capsys.readouterr().out
