import dataclasses
import errno
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
import tensorflow_datasets as tfds

import data_specs.tactip_paired
import data_specs.tactip_pose
from jaxunshear.config.configs import CONFIGS, get_set_folder, get_unfinished_folder
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.splits import SPLITS
from jaxunshear.config.stimuli import Outline
from jaxunshear.data.builders import SetConfig, compute_sha256
from jaxunshear.data.chunks import load_chunk
from jaxunshear.data.sampling import sample_contacts
from jaxunshear.data.sources import open_source
from jaxunshear.data.stored_sets import make_set
from jaxunshear.errors import UserError

BUILDERS = {
    "tactip_paired": data_specs.tactip_paired.Builder,
    "tactip_pose": data_specs.tactip_pose.Builder,
}


def checksums(folder: Path) -> dict[str, str]:
    return {path.name: compute_sha256(path) for path in sorted(folder.iterdir())}


def test_a_library_that_came_in_parts_is_one_line():
    """TFDS logs what its import raises, and gives a module without its parts."""
    parts = (
        "import sys, types; "
        "sys.modules['tensorflow_datasets'] = types.ModuleType('tensorflow_datasets')"
    )
    words = [sys.executable, "-c", f"{parts}; import jaxunshear.data.builders"]
    said = subprocess.run(words, check=False, capture_output=True, text=True).stderr
    assert said.splitlines()[-1].startswith(
        "jaxunshear.errors.UserError: tensorflow_datasets could not be imported"
    )


@pytest.mark.parametrize("name", CONFIGS)
def test_standard_sets_are_known_to_tfds_by_name(name, engine, tmp_path, monkeypatch):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    assert list(BUILDERS[name].builder_configs) == list(CONFIGS[name])
    builder = tfds.builder(f"{name}/tiny", data_dir=tmp_path)
    builder.engine = engine
    builder.download_and_prepare()
    settings = CONFIGS[name]["tiny"]
    each = settings.slides if name == "tactip_paired" else 1
    counts = [builder.info.splits[split].num_examples for split in SPLITS]
    assert counts == [18 * each, 6 * each, 6 * each]
    for example in tfds.builder(f"{name}/tiny", data_dir=tmp_path).as_data_source("test"):
        image = example["sheared" if name == "tactip_paired" else "image"]
        assert image.shape == (128, 128, 1)
        assert set(np.unique(image)) == {0, 255}
        assert example["pose"].dtype == np.float32
    assert not (tmp_path / "downloads").exists()
    assert list((tmp_path / ".partial").iterdir()) == []
    assert not list((tmp_path / "temporary").iterdir())


@pytest.mark.parametrize("name", CONFIGS)
def test_the_data_card_and_the_citation_come_along(name):
    metadata = BUILDERS[name].get_metadata()
    for word in ("simulated", "mm", "Licence", "Splits", "Limits"):
        assert word in metadata.description
    assert "Induced Shear" in metadata.citation
    known = [tag.split(" ")[0] for tag in tfds.core.dataset_metadata.valid_tags()]
    assert set(metadata.tags) <= set(known)
    card = " ".join(metadata.description.split())
    builder = BUILDERS[name](config="tiny", data_dir="/nowhere")
    for field in builder.info.features:
        assert f"`{field}`" in card, field
    for config in CONFIGS[name]:
        assert f"`{config}`" in card


def test_metadata_gives_settings_and_counts(paired, sensor, engine, tmp_path):
    metadata = make_set(paired, sensor, tmp_path, engine)
    assert metadata["settings"]["stimuli"] == ["disk", "spiral_1"]
    assert metadata["sensor"]["name"] == "small"
    assert metadata["counts"]["written"] == {"train": 36, "validation": 12, "test": 12}
    assert metadata["counts"]["dropped_scenes"] == []
    file = get_set_folder(paired, sensor, tmp_path) / "metadata.json"
    assert metadata == json.loads(file.read_text())


def test_a_set_of_an_outline_calls_it_by_its_name(paired, sensor, engine, tmp_path):
    kite = Outline("kite", ((0, -15), (12, 0), (0, 25), (-12, 0)))
    own = dataclasses.replace(paired, stimuli=("disk", kite))
    metadata = make_set(own, sensor, tmp_path, engine)
    assert metadata["settings"]["stimuli"][1]["points"][1] == [12, 0]
    # found again
    assert make_set(own, sensor, tmp_path, engine._replace(simulate=None)) == metadata
    rows = tfds.builder_from_directory(get_set_folder(own, sensor, tmp_path)).as_data_source("test")
    assert rows.dataset_info.features["stimulus"].names == ["disk", "kite"]
    assert {int(row["stimulus"]) for row in rows} == {0, 1}
    edge = np.array([row["edge"][0] for row in rows if row["stimulus"] == 1])
    assert np.ptp(edge) > 1 and np.abs(edge).max() < 9  # mm from its edge, which the target is on


def test_both_sets_of_an_experiment(paired, pose, sensor, engine, tmp_path):
    experiment = Experiment(name="x", claim="", sensor=sensor, paired=paired, pose=pose)
    made = open_source(experiment).make_sets(tmp_path, engine)
    assert list(made) == ["tactip_paired", "tactip_pose"]


def test_a_set_is_made_once_and_the_same_again_elsewhere(pose, sensor, engine, tmp_path):
    make_set(pose, sensor, tmp_path / "a", engine)
    # would fail if it simulated
    make_set(pose, sensor, tmp_path / "a", engine._replace(simulate=None))
    make_set(pose, sensor, tmp_path / "b", engine)
    first, second = (checksums(get_set_folder(pose, sensor, tmp_path / name)) for name in "ab")
    assert first == second
    assert sum("array_record" in name for name in first) == 3


def test_other_settings_in_the_same_place_are_refused_by_field(pose, sensor, engine, tmp_path):
    make_set(pose, sensor, tmp_path, engine)
    other = dataclasses.replace(pose, seed=9, ranges=dataclasses.replace(pose.ranges, yaw_deg=5.0))
    folder = get_set_folder(other, sensor, tmp_path)
    folder.parent.mkdir()
    os.rename(get_set_folder(pose, sensor, tmp_path), folder)
    with pytest.raises(
        UserError, match=r"another settings\.ranges\.yaw_deg, settings\.seed: delete"
    ):
        make_set(other, sensor, tmp_path, engine)
    assert folder.exists()


@pytest.mark.parametrize("stage", ["chunks", "shards"])
def test_a_full_disk_loses_nothing(stage, pose, sensor, engine, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        if stage == "chunks":
            replace = os.replace

            def full(source, target):
                if "00001" in str(target):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                return replace(source, target)

            patch.setattr(os, "replace", full)
        else:  # what array_record's writer raised on a file system of 1 MB

            def full(path, iterator):
                raise RuntimeError(
                    f"write() failed: {os.strerror(errno.ENOSPC)}; writing {path}; "
                    "Failed to close chunk_writer"
                )

            patch.setattr(tfds.core.file_adapters.ArrayRecordFileAdapter, "write_examples", full)
        with pytest.raises(UserError, match="disk is full"):
            make_set(pose, sensor, tmp_path, engine)
    assert not get_set_folder(pose, sensor, tmp_path).exists()
    left = len(list(get_unfinished_folder(pose, sensor, tmp_path).glob("*.npz")))
    assert left == {"chunks": 1, "shards": 2}[stage]
    make_set(pose, sensor, tmp_path, engine)


def test_a_folder_that_is_a_file_is_refused(pose, sensor, engine, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="file"):
        make_set(pose, sensor, tmp_path / "file", engine)


def test_nothing_that_converges_is_refused(pose, sensor, engine, tmp_path):
    def never(sensor, names, scenes):
        contacts = engine.simulate(sensor, names, scenes)
        contacts.converged[:] = False
        return contacts

    with pytest.raises(UserError, match="no contact of split 'train' converged"):
        make_set(pose, sensor, tmp_path, engine._replace(simulate=never))


SCRIPT = """
import runpy, sys
from pathlib import Path
from jaxunshear.data.stored_sets import make_set
fake = runpy.run_path(sys.argv[1])
make_set(fake["PAIRED"], fake["SENSOR"], Path(sys.argv[2]), fake["ENGINE"])
"""


def start(folder: Path, seconds: float) -> subprocess.Popen:
    stand_in = Path(__file__).with_name("conftest.py")
    words = [sys.executable, "-c", SCRIPT, str(stand_in), str(folder)]
    environment = {**os.environ, "FAKE_SECONDS": str(seconds)}
    return subprocess.Popen(words, env=environment, stderr=subprocess.PIPE, text=True)


def test_a_killed_run_goes_on_to_the_same_bits(paired, sensor, engine, tmp_path):
    make_set(paired, sensor, tmp_path / "full", engine)
    chunks = get_unfinished_folder(paired, sensor, tmp_path / "killed")
    process = start(tmp_path / "killed", 0.5)
    try:
        deadline = time.monotonic() + 60
        while (
            len(list(chunks.glob("*.npz"))) < 3
            and time.monotonic() < deadline
            and process.poll() is None
        ):
            time.sleep(0.01)
        with pytest.raises(UserError, match="another process"):
            make_set(paired, sensor, tmp_path / "killed", engine)
        process.send_signal(signal.SIGKILL)
    finally:
        process.kill()
        process.communicate()
    kept = {path.name: path.stat().st_mtime_ns for path in chunks.glob("*.npz")}
    assert 3 <= len(kept) < len(engine.plan(sensor, paired.stimuli, sample_contacts(paired).scenes))
    assert not get_set_folder(paired, sensor, tmp_path / "killed").exists()
    half = chunks.with_name("seen")
    half.mkdir()
    for name in kept:
        os.link(chunks / name, half / name)
    make_set(paired, sensor, tmp_path / "killed", engine)
    assert {path.name: path.stat().st_mtime_ns for path in half.iterdir()} == kept
    assert all(load_chunk(path)["usable"].all() for path in half.iterdir())
    full, killed = [get_set_folder(paired, sensor, tmp_path / name) for name in ("full", "killed")]
    assert checksums(killed) == checksums(full)
    assert not chunks.exists()


def test_what_a_run_killed_while_writing_shards_left_is_cleared(pose, sensor, engine, tmp_path):
    left = get_set_folder(pose, sensor, tmp_path).parent / f"incomplete.ABC123_{pose.version}"
    left.mkdir(parents=True)
    (left / "tactip_pose-train.array_record-00000-of-00001").write_bytes(b"half")
    make_set(pose, sensor, tmp_path, engine)
    assert [path.name for path in left.parent.iterdir()] == [pose.version]


def test_chunks_left_by_a_run_killed_at_its_very_end_are_cleared(pose, sensor, engine, tmp_path):
    make_set(pose, sensor, tmp_path, engine)
    chunks = get_unfinished_folder(pose, sensor, tmp_path)
    chunks.mkdir()
    make_set(pose, sensor, tmp_path, engine)
    assert not chunks.exists()


def test_a_set_of_other_settings_is_readable_without_its_code(pose, sensor, engine, tmp_path):
    make_set(pose, sensor, tmp_path, engine)
    builder = tfds.builder_from_directory(get_set_folder(pose, sensor, tmp_path))
    assert re.fullmatch("custom-[0-9a-f]{8}", builder.builder_config.name)
    assert builder.info.features["stimulus"].names == ["disk", "spiral_1"]
    assert len(builder.as_data_source("train")) == 12
    assert SetConfig(name="x").sensor.pins == 331
