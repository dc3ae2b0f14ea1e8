"""Rows for machines: names, units, bars."""

import pytest

from jaxunshear.evaluation.measurements import BARS, build_measurements, select_reproducible
from jaxunshear.files import to_builtins
from jaxunshear.results.record_files import convert_record
from jaxunshear.results.run import Results


def results(unsheared=0.95, sheared=0.32, ratio=0.5):
    return {
        "metric": {"ms_ssim": "ms_ssim@4"},
        "ms_ssim": {
            "sheared": {"disk": 0.3, "overall": sheared},
            "disentangled": {"disk": None, "overall": unsheared},
        },
        "pose_mae": {"tap": {"x_mm": 0.4, "yaw_deg": 2.0}},
        "pose_ratio": {"disentangled": {"edge_mm": ratio, "edge_deg": ratio}},
        "pose_recovery": {"disentangled": {"edge_mm": 0.9}},
        "difference": {"entangled": {"ms_ssim": 0.01, "edge_mm": -0.1}},
        "tests": {},
        "ms_per_image": {"unet": {"median": 3.0, "p95": 4.0}},
        "swap": {"DC(z_p)": {"target": "tap", "mse": 0.02}},
        "pin_error": {
            "tap": {"rms_px": 0.1, "rms_mm": 0.02, "missed_per_image": 0.5, "extra_per_image": 0.0}
        },
        "time_s": {"train": 100.0},
        "machine": {"cores": 2},
        "versions": {"jax": "0"},
        "command": "jaxunshear run",
        "settings": {},
    }


def record(held):
    return convert_record(held, Results, "made up", "again")


def by_name(found):
    return {row.name: row for row in found.rows}


def test_every_bar_has_its_row_and_good_results_clear_all():
    rows = by_name(build_measurements(record(results())))
    assert set(BARS) <= set(rows)
    assert all(rows[name].ok is True for name in BARS)
    assert all(row.ok is None for name, row in rows.items() if name not in BARS)


@pytest.mark.parametrize(
    ("case", "failed"),
    [
        ({"unsheared": 0.899}, {"ms_ssim.disentangled.overall"}),
        ({"sheared": 0.46}, {"ms_ssim.sheared.overall"}),
        ({"ratio": 0.61}, {"pose_ratio.disentangled.edge_mm", "pose_ratio.disentangled.edge_deg"}),
        ({"unsheared": None}, {"ms_ssim.disentangled.overall"}),
    ],
)
def test_a_missed_bar_is_not_ok(case, failed):
    rows = by_name(build_measurements(record(results(**case))))
    assert {name for name, row in rows.items() if row.ok is False} == failed


def test_time_per_image_has_a_row():
    row = by_name(build_measurements(record(results())))["ms_per_image.unet"]
    assert (row.value, row.unit) == (3.0, "ms")


def test_units_and_metric():
    rows = by_name(build_measurements(record(results())))
    assert rows["ms_ssim.sheared.overall"].metric == "ms_ssim@4"
    assert rows["ms_ssim.sheared.overall"].unit == "1"
    assert rows["pose_mae.tap.x_mm"].unit == "mm"
    assert rows["pose_mae.tap.yaw_deg"].unit == "deg"
    assert rows["pose_ratio.disentangled.edge_mm"].unit == "1"
    assert rows["pin_error.tap.rms_px"].unit == "px"
    assert rows["pin_error.tap.missed_per_image"].unit == "pins/image"
    assert rows["time_s.train"].unit == "s"
    assert "swap.DC(z_p).target" not in rows


def test_readers_of_another_make_have_rows():
    reported = {"pixels": {"tap": {"edge_mm": 0.4, "edge_deg": None}}}
    full = results() | {
        "readers": reported,
        "metric": {"ms_ssim": "ms_ssim@4", "readers": "of a kernel ridge"},
    }
    row = by_name(build_measurements(record(full)))["readers.pixels.tap.edge_mm"]
    assert (row.value, row.unit, row.metric) == (0.4, "mm", "of a kernel ridge")


def test_reproducible_leaves_out_times_and_places_only():
    code = {"version": "1", "date": "2026-01-01", "commit": "c", "clean": True}
    full = results() | {
        "trained_on": {"posenet": {"cores": 2}},
        "source": code,
        "trained_by": {"posenet": code},
    }
    assert set(to_builtins(record(full))) - set(select_reproducible(record(full))) == {
        "time_s",
        "ms_per_image",
        "machine",
        "trained_on",
        "source",
        "trained_by",
        "command",
    }
    assert set(to_builtins(build_measurements(record(full)))) >= {"source", "trained_by", "command"}
