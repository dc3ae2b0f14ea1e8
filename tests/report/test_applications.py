"""What the networks were put to, on the page of their run."""

import pytest

from jaxunshear.errors import UserError
from jaxunshear.files import write_bytes, write_json
from jaxunshear.report import applications
from jaxunshear.report.report import write_report

GEOMETRY = {"way": "inverse", "stimulus": "all", "kind": "tap", "contacts": 90, "unmatched": 1}
GEOMETRY |= {"ms_per_image": 12.3}
SCORES = {"correlation": 0.7381, "correlation_interval": [0.699, 0.775]}
SCORES |= {"rmse_mm": 0.677, "rmse_mm_interval": [0.58, 0.77]}
WALK = {"stimulus": "disk", "way": "disentangled", "starts": 5, "closed": 4, "perceive_ms": 6.5}
WALK |= {"mean_mm": 0.214, "p95_mm": 0.5, "largest_mm": 1.23}
OBJECT = {"stimulus": "disk", "object": "voronoi", "way": "disentangled"}
OBJECT |= {"iou": 0.9715, "mean_mm": 0.42, "hausdorff_mm": 1.2}
LATENCY = {"p50": 7.25, "p95": 8.0, "p99": 9.0}
STREAM = {"used": 998, "skipped": 2, "dropped": 0, "latency_ms": LATENCY}


def put(folder, name, results):
    write_json(folder / f"{name}.json", {"command": f"jaxunshear {name}", **results})


def test_what_was_run_is_shown_and_nothing_else(run):
    assert applications.build_sections(run) == {}
    page = write_report(run).read_text()
    assert "Contact geometry" not in page and "Complete objects" not in page
    of_disk = GEOMETRY | {"stimulus": "disk", "correlation": 0.111}
    put(run / "geometry", "geometry", {"rows": [GEOMETRY | SCORES, of_disk]})
    put(run / "servo", "servo", {"rows": [WALK]})
    put(run / "servo", "reconstruct", {"rows": [OBJECT]})
    put(run / "stream", "stream", STREAM)
    write_bytes(run / "servo" / "disk.png", b"a picture")
    page = write_report(run).read_text()
    for text in (
        *("0.738", "[0.699, 0.775]", "1 of 90", "inverse", "4 of 5", "0.21 / 0.50 / 1.23"),
        *("0.972", "disk, voronoi", "998", "7.2"),
    ):
        assert text in page, text
    assert "0.111" not in page
    assert sum(section.count("<img") for section in applications.build_sections(run).values()) == 1


def test_a_network_that_lost_its_pins_has_a_dash(run):
    put(run / "geometry", "geometry", {"rows": [GEOMETRY]})
    assert "\u2013" in applications.build_sections(run)["geometry"]


def test_damage_is_reported(run):
    put(run / "servo", "servo", {"rows": [{}]})
    with pytest.raises(UserError, match=r"servo\.json lacks 'way'"):
        write_report(run)


@pytest.fixture
def run(made_up_run):
    return made_up_run[0]
