"""Files of results: there and back, earlier and later forms, what is wrong in them."""

import json
from pathlib import Path

import pytest

from jaxunshear.errors import UserError
from jaxunshear.files import write_json
from jaxunshear.results.measurement import Machine
from jaxunshear.results.record_files import SCHEMA, read_record, write_record
from jaxunshear.results.run import Results
from jaxunshear.results.sweep import SweepResult

ROOT = Path(__file__).resolve().parents[2]
RESULTS = Results(
    settings={"unshear": {"input": "pins"}},
    metric={"ms_ssim": "ms_ssim@4", "image_px": 128},
    pin_error={"tap": {"rms_px": 0.5, "rms_mm": None}},
    pose_mae={"tap": {"x_mm": 1.0}},
    machine=Machine(cores=2),
    trained_on={"posenet": Machine(cores=2, kernels="plain")},
)


def test_what_is_written_is_read(tmp_path):
    write_record(tmp_path / "results.json", RESULTS)
    assert read_record(tmp_path / "results.json", Results, "again") == RESULTS
    held = json.loads((tmp_path / "results.json").read_text())
    assert held["schema"] == SCHEMA and held["pin_error"]["tap"] == {"rms_px": 0.5, "rms_mm": None}
    # None is left out where that is the default
    assert "recordings" not in held and "kernels" not in held["machine"]
    bare = {name: value for name, value in held.items() if name not in ("schema", "checksum")}
    write_json(tmp_path / "first.json", bare)  # a file without a form is of the first
    assert read_record(tmp_path / "first.json", Results, "again") == RESULTS


@pytest.mark.parametrize(
    ("held", "line"),
    [
        (
            {"schema": SCHEMA + 1},
            rf"a\.json has the form {SCHEMA + 1}.*{SCHEMA}: upgrade jaxunshear, or run it again",
        ),
        ({"settings": {}, "metric": {}}, r"a\.json lacks 'pin_error': run it again"),
        (
            {"settings": {}, "metric": {}, "pin_error": {"tap": {"rms_px": "much"}}},
            r"a\.json lacks .*pin_error.*run it",
        ),
        ([], r"a\.json lacks .*run it again"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(tmp_path, held, line):
    (tmp_path / "a.json").write_text(json.dumps(held))
    with pytest.raises(UserError, match=line):
        read_record(tmp_path / "a.json", Results, "run it again")


@pytest.mark.parametrize("name", ["standard", "demo", "frontier", "recorded_pins", "parted"])
def test_stored_sweeps_are_read(name):
    found = read_record(ROOT / "docs" / "results" / f"{name}.json", SweepResult, "again")
    assert all(cell.metrics for cell in found.cells)
