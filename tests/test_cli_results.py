"""Results are written with their command, and refused if something would be lost."""

import json

import pytest

from jaxunshear.cli import main


def test_a_calibration_writes_statistics_and_parameters(tmp_path, monkeypatch):
    rows = {"rows": [{"name": "pin spacing"}], "parameters": [{"name": "friction"}]}
    monkeypatch.setattr("jaxunshear.calibration.calibrate.calibrate", lambda recordings, out: rows)
    file = tmp_path / "calibration.json"
    assert main(["calibrate", "recordings", "--json", str(file)]) == 0
    assert json.loads(file.read_text())["rows"] == rows["rows"] + rows["parameters"]


def test_recordings_that_are_not_there_are_refused_in_one_line(command):
    answer = command("calibrate", "nowhere")
    assert (answer.code, answer.err.count("\n")) == (2, 1) and "nowhere" in answer.err


def test_a_folder_cannot_be_the_file_of_rows(tmp_path, capsys):
    assert main(["calibrate", "recordings", "--json", str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err
    (tmp_path / "file").touch()
    assert (
        main(["calibrate", "recordings", "--json", str(tmp_path / "file" / "deeper" / "rows.json")])
        == 2
    )
    assert f"{tmp_path / 'file'} is a file" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", [("calibrate", "recordings"), ("run", "experiments/tiny.py"), ("servo",)]
)
def test_a_file_cannot_be_the_folder_of_results(tmp_path, capsys, words):
    (tmp_path / "file").touch()
    assert main([*words, "--out", str(tmp_path / "file")]) == 2
    assert f"--out {tmp_path / 'file'} is a file: name a folder" in capsys.readouterr().err
    assert main([*words, "--out", str(tmp_path / "file" / "deeper")]) == 2
    assert f"{tmp_path / 'file'} is a file: name another folder" in capsys.readouterr().err
