"""What a plan shows: what is left out, and what that costs."""

from dataclasses import replace

import pytest

from jaxunshear.errors import UserError
from jaxunshear.simulator.level import OMISSIONS
from jaxunshear.simulator.scene import Scenes
from verification import plan_report as module
from verification.contact_case import HALF_SIZE
from verification.paper import sample_paper_scenes
from verification.plan_report import PlannedContact, show_grouping, show_plan

SMALL = replace(HALF_SIZE, name="small")


def by_name(shown) -> dict:
    return {row["omission"]: row for row in shown.rows}


def test_a_slide():
    shown = show_plan(PlannedContact("disk", (-6, 0, 10, 1.0), move=(0.4, 0.0)), sensor=SMALL)
    rows = by_name(shown)
    assert set(rows) == {"", module.TOGETHER, *OMISSIONS}
    needs = rows[""]
    assert (
        needs["touching"]
        and needs["friction"]
        and needs["converged"]
        and 0 < needs["nodes"] < needs["nodes_of"]
    )
    assert rows["nodes"]["matters"] and rows["nodes"]["ms"] > 0 and rows["nodes"]["max_px"] < 0.3
    assert (
        rows["steps"]["matters"]
        and not rows["friction"]["matters"]
        and not rows["grouping"]["matters"]
    )
    assert (
        f"{needs['nodes']} of {needs['nodes_of']}" in shown.text
        and "makes no difference here" in shown.text
    )


def test_nothing_is_touched():
    rows = by_name(show_plan(PlannedContact("disk", (40.0, 0, 0, 1.0)), sensor=SMALL))
    assert not rows[""]["touching"] and rows[""]["nodes"] == 0 and rows["untouched"]["matters"]
    assert rows["untouched"]["max_px"] == pytest.approx(0, abs=1e-4)


def test_no_friction():
    rows = by_name(
        show_plan(
            PlannedContact("disk", (-6, 0, 0, 0.8), move=(0.4, 0), friction=0.0), sensor=SMALL
        )
    )
    assert (
        not rows[""]["friction"]
        and rows["friction"]["matters"]
        and rows["friction"]["rms_px"] < 0.1
    )


def test_a_level_that_leaves_nothing_out():
    shown = show_plan(PlannedContact("disk", (-6, 0, 0, 0.8)), level="default", sensor=SMALL)
    assert (
        not any(row.get("matters") for row in shown.rows)
        and "not left out at this level" in shown.text
    )


def test_groups_hold_every_scene_once():
    def shallow(kind: str, count: int) -> Scenes:
        found = sample_paper_scenes(kind, count)
        found.pose[:, 3] = 1.0
        return found

    shown = show_grouping(3, sensor=SMALL, scenes=shallow)
    for kind in ("slide", "tap"):
        assert (
            sum(row["scenes"] for row in shown.rows if row["kind"] == kind and not row["omission"])
            == 3
        )
    assert any(row["omission"] == "grouping" for row in shown.rows)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"stimulus": "pyramid"}, "pyramid"),
        ({"pose": (0, 0, 0, float("nan"))}, "not finite"),
        ({"pose": (0, 0, 0, 50)}, "depth 50"),
        ({"friction": -1.0}, "friction -1"),
    ],
)
def test_what_cannot_be_shown_is_refused(arguments, said):
    with pytest.raises(UserError, match=said):
        show_plan(PlannedContact(**{"stimulus": "disk", "pose": (0, 0, 0, 1), **arguments}))
    with pytest.raises(UserError, match="best"):
        show_plan(PlannedContact("disk", (0, 0, 0, 1)), level="best")
    with pytest.raises(UserError, match="--scenes 0"):
        show_grouping(0)
