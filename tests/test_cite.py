"""`cite`: BibTeX of the software, the paper and the recordings."""

import re
from pathlib import Path

from jaxunshear import __version__

ROOT = Path(__file__).resolve().parents[1]


def test_all_are_printed_or_one(command):
    everything = command("cite").out
    names = re.findall(r"^@\w+\{(\w+),$", everything, re.MULTILINE)
    assert names[:2] == ["jaxunshear", "gupta2021tactile"] and len(names) == 4
    assert "".join(command("cite", name).out + "\n" for name in names) == everything + "\n"
    assert f"version = {{{__version__}}}" in command("cite", "jaxunshear").out


def test_they_agree_with_other_files(command):
    for file in ROOT.glob("data_specs/*/CITATIONS.bib"):
        assert file.read_text() == command("cite", "gupta2021tactile").out
    software = command("cite", "jaxunshear").out.replace("{JAX}", "JAX")
    for line in (ROOT / "CITATION.cff").read_text().splitlines():
        if found := re.match(r"(?:title|license): \"?(.*?)\"?$", line):
            assert f"{{{found[1]}}}" in software


def test_an_unknown_name_is_refused_with_those_there_are(command):
    answer = command("cite", "me")
    assert answer.code == 2 and answer.err.count("\n") == 1
    assert "use one of jaxunshear, gupta2021tactile, church2021tactile" in answer.err
