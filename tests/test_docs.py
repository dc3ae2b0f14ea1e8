"""The documents: their figures are those of docs/results, their links lead somewhere, their commands exist."""

import contextlib
import re
from pathlib import Path

import pytest

from docs.make_tables import TABLES, placed, with_notes
from docs.provenance import NOTE
from jaxunshear import __version__
from jaxunshear.cli import main
from jaxunshear.settings.rules import validate

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    path.relative_to(ROOT).as_posix()
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md"))
)
MOST_LINES = {"README.md": 120}


@pytest.mark.parametrize("page", TABLES)
def test_tables_are_what_the_results_say(page):
    tables = with_notes(page)
    assert all(len(table.splitlines()) > 3 for table, _ in tables)
    assert placed((ROOT / page).read_text(), tables) == (ROOT / page).read_text(), "call `make tables`"


def test_tables_go_where_a_page_has_their_first_lines():
    page = f"words\n\n| a | b |\n\nmore\n\n| a | b |\n|---|---|\n| 1 | 2 |\n\n{NOTE}old</sub>\n\nend\n"
    tables = [(f"| a | b |\n|---|---|\n| {value} | 0 |", f"{NOTE}{value}</sub>") for value in (7, 8)]
    made = placed(page, tables)
    assert made == "\n\n".join(("words", *tables[0], "more", *tables[1], "end")) + "\n"
    assert placed(made, tables) == made
    with pytest.raises(LookupError, match=r"begins with '\| a \| b \|': write"):
        placed(page, [*tables, tables[0]])


def anchors(page: Path) -> set[str]:
    """Those of a page's headings, as GitHub names them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    text = (ROOT / page).read_text()
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" in link:
            continue
        place, _, anchor = link.partition("#")
        there = (ROOT / page).parent / place if place else ROOT / page
        assert there.exists(), f"{page}: {link}"
        assert not anchor or anchor in anchors(there), f"{page}: {link}"


@pytest.mark.parametrize("page", PAGES)
def test_commands_exist(page, capsys):
    with contextlib.suppress(SystemExit):
        main(["--help"])
    known = set(re.findall(r"^  (check [a-z]+|[a-z]+) ", capsys.readouterr().out, re.MULTILINE))
    named = set(re.findall(r"(?:^    |`)jaxunshear (check [a-z]+|[a-z]+)", (ROOT / page).read_text(), re.MULTILINE))
    assert named <= known, f"{page}: {named - known}"


@pytest.mark.parametrize("page", PAGES)
def test_pages_are_short(page):
    """Not counting what stands under tables, which `make tables` writes."""
    lines = (ROOT / page).read_text().splitlines()
    notes = sum(line.startswith(NOTE) for line in lines)
    assert len(lines) - 2 * notes <= MOST_LINES.get(page, 200)


@pytest.mark.parametrize("page", ["docs/simulator.md"])
def test_examples_of_settings_run(page):
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    names: dict = {}
    exec(example, names)
    validate(names["experiment"])


def test_one_version():
    named = {re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)[1]}
    named.add(re.search(r"^## (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1])
    assert named == {__version__}


UNPLAIN = r"\b(look|told|begun|whole|tell|tells|mended)\b"  # words that said too many things
PLACES = ("jaxunshear/**/*.py", "data_specs/**/*.py", "experiments/**/*.py", "docs/*.md", "docs/*.py", "*.md")


@pytest.mark.parametrize("place", PLACES)
def test_words_are_plain(place):
    files = [path for path in ROOT.glob(place) if path.name != "CHANGELOG.md"]
    assert files
    found = [f"{path}: {word}" for path in files for word in re.findall(UNPLAIN, path.read_text(), re.IGNORECASE)]
    assert not found
