"""Run the commands of tutorials on a small recording in the published layout."""

import re
import shlex

import made
import pytest
from conftest import ROOT, SHORT

PAGES = ("your-own-recordings", "another-day", "robot", "pairings")
TRAINS = ("fit", "sweep")
USES = ("doctor", "unshear", "evaluate", "adapt", "stream", "release")
ABSENT = ("camera:0", "stream list", "--pairs")  # no camera is there, and no table of pairs


def commands():
    lines = "\n".join((ROOT / "docs" / f"{page}.md").read_text() for page in PAGES).splitlines()
    return [
        line.strip()
        for line in lines
        if re.match(r" {4}jaxunshear ", line) and not any(word in line for word in ABSENT)
    ]


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    """A folder as the tutorial has it, some days of recordings in it."""
    place = tmp_path_factory.mktemp("laboratory")
    made.edge(place / "recordings" / "edge", 120, 120)
    made.edge(place / "recordings" / "another_day", 20, 20, seed=77)
    made.edge(place / "recordings" / "monday", 30, 30, seed=78)
    made.edge(place / "recordings" / "monday_test", 20, 20, seed=79)
    (place / "experiments").symlink_to(ROOT / "experiments")
    return place


@pytest.mark.long
def test_every_command_of_the_pages_works_in_its_order(command, laboratory, monkeypatch):
    monkeypatch.chdir(laboratory)
    done = []
    for line in commands():
        words = shlex.split(line)[1:]
        if words[0] in TRAINS:
            words += ["--train_pins.epochs", "1", *SHORT[4:]]
        if words[0] == "sweep":
            words += ["--seeds", "0", "--networks", "disentangled,posenet"]
        answer = command(*words)
        assert answer.code == 0, f"{line}: {answer.err}"
        done.append(words[0])
    assert {*TRAINS, *USES} <= set(done)
    assert (laboratory / "runs" / "edge" / "report.html").exists()
    assert (laboratory / "edge_weights" / "README.md").exists()
