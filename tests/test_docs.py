"""Documents: figures are those of docs/results, links lead somewhere, commands exist."""

import contextlib
import re
from pathlib import Path

import pytest

from benchmarks import commands as benchmarks
from docs.make_tables import TABLES, make_tables, replace_tables
from docs.provenance import NOTE
from jaxunshear import __version__
from jaxunshear.cli import main
from jaxunshear.config.rules import validate
from verification import commands as verification

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    path.relative_to(ROOT).as_posix()
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md"))
)
MOST_LINES = {"README.md": 140}


@pytest.mark.parametrize("page", TABLES)
def test_tables_are_what_the_results_say(page):
    tables = make_tables(page)
    assert all(len(table.splitlines()) > 3 for table, _ in tables)
    assert replace_tables((ROOT / page).read_text(), tables) == (ROOT / page).read_text(), (
        "call `make tables`"
    )


def test_tables_go_where_a_page_has_their_first_lines():
    page = (
        f"words\n\n| a | b |\n\nmore\n\n| a | b |\n|---|---|\n| 1 | 2 |\n\n{NOTE}old</sub>\n\nend\n"
    )
    tables = [
        (f"| a | b |\n|---|---|\n| {value} | 0 |", f"{NOTE}{value}</sub>") for value in (7, 8)
    ]
    made = replace_tables(page, tables)
    assert made == "\n\n".join(("words", *tables[0], "more", *tables[1], "end")) + "\n"
    assert replace_tables(made, tables) == made
    with pytest.raises(LookupError, match=r"begins with '\| a \| b \|': write"):
        replace_tables(page, [*tables, tables[0]])


def anchors(page: Path) -> set[str]:
    """Those of a page's headings, as GitHub names them, and of its `<a id>`."""
    text = page.read_text()
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    named = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
    return named.union(re.findall(r'<a id="([^"]+)"', text))


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
    lines = (ROOT / page).read_text().splitlines()
    text = "\n".join(
        line for line in lines if not line.startswith(NOTE)
    )  # notes have commands as they were typed
    known = set(re.findall(r"^  ([a-z-]+) ", capsys.readouterr().out, re.MULTILINE))
    named = set(re.findall(r"(?:^    |`)jaxunshear ([a-z-]+)", text, re.MULTILINE))
    assert named <= known, f"{page}: {named - known}"
    for tool in (verification, benchmarks):
        named = set(re.findall(rf"python -m {tool.__package__} ([a-z_]+)", text))
        assert named <= tool.COMMANDS.keys(), f"{page}: {named - tool.COMMANDS.keys()}"


@pytest.mark.parametrize("page", PAGES)
def test_pages_are_short(page):
    """Not counting code, nor what stands under tables, which `make tables` writes."""
    text = re.sub(r"```python\n.*?```\n", "", (ROOT / page).read_text(), flags=re.DOTALL)
    lines = text.splitlines()
    notes = sum(line.startswith(NOTE) for line in lines)
    assert len(lines) - 2 * notes <= MOST_LINES.get(page, 200)


@pytest.mark.parametrize("page", ["docs/shapes.md"])
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
PLACES = (
    *(
        f"{folder}/**/*.py"
        for folder in ("jaxunshear", "verification", "benchmarks", "data_specs", "experiments")
    ),
    *("docs/*.md", "docs/*.py", "*.md"),
)


@pytest.mark.parametrize("place", PLACES)
def test_words_are_plain(place):
    files = [path for path in ROOT.glob(place) if path.name != "CHANGELOG.md"]
    assert files
    found = [
        f"{path}: {word}"
        for path in files
        for word in re.findall(UNPLAIN, path.read_text(), re.IGNORECASE)
    ]
    assert not found
