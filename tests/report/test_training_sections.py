"""Logs and times with damage in them: the rest is read, and a note names the file."""

import json

import pytest

from jaxunshear.errors import Note
from jaxunshear.files import add_checksum, write_json
from jaxunshear.report.training_sections import read_history
from jaxunshear.results.record_files import read_times


def test_a_damaged_line_is_left_out_with_a_note(tmp_path):
    path = tmp_path / "log.jsonl"
    logged = {"train_seconds": 1.5, "train": {"loss": 0.25}}
    lines = [json.dumps(add_checksum({"epoch": at, **logged})) for at in (1, 2, 3)]
    path.write_text("\n".join(lines) + "\n")
    assert read_history(path).epoch == [1, 2, 3]
    path.write_text("\n".join([lines[0], lines[1].replace("0.25", "0.35"), lines[2]]) + "\n")
    with pytest.warns(Note, match=r"log\.jsonl is damaged: 1 of its lines"):
        assert read_history(path).epoch == [1, 3]


def test_damaged_times_are_left_out_with_a_note(tmp_path):
    assert read_times(tmp_path) == {}
    write_json(tmp_path / "times.json", {"data": 12.5})
    assert read_times(tmp_path) == {"data": 12.5}
    path = tmp_path / "times.json"
    path.write_text(path.read_text().replace("12.5", "92.5"))
    with pytest.warns(Note, match=r"times\.json is damaged"):
        assert read_times(tmp_path) == {}
