"""Changes pages for `make docs`.

README becomes the first page, and files at the top of the repository become pages.
"""

import argparse
import json
import re
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from jaxunshear.cli import GROUPS, make_parser
from jaxunshear.cli.fields import format_field_help, list_group_names

ROOT = Path(__file__).resolve().parents[1]
TOP = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
    "CHANGELOG.md": "CHANGELOG.md",
}
LINKED_MODULES = (
    "api.py",
    "config/losses.py",
    "config/networks.py",
    "training/losses.py",
    "models/registry.py",
    "data/sources.py",
    "perception/touch.py",
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages at the top of the repository, and the files that pages lead to."""
    for source, page in TOP.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text()))
    content = "\n".join(format_options())
    files.append(File.generated(config, "reference/options.md", content=content))
    for notebook in (ROOT / "docs" / "notebooks").glob("*.ipynb"):
        page = f"notebooks/{notebook.stem}.md"
        files.append(File.generated(config, page, content=format_notebook(notebook)))
    for path in (
        *ROOT.glob("experiments/**/*.py"),
        *ROOT.glob("examples/*.*"),
        *ROOT.glob("jaxunshear/weights/*/README.md"),
        *ROOT.glob("data_specs/*/README.md"),
        *(ROOT / "jaxunshear" / path for path in LINKED_MODULES),
    ):
        name = path.relative_to(ROOT).as_posix()
        if path.suffix == ".md":  # the card of a model or of a data set is a page
            files.append(File.generated(config, name, content=path.read_text()))
        else:
            files.append(File.generated(config, f"{name}.txt", content=path.read_text()))
    return files


def format_notebook(notebook: Path) -> str:
    """Format a notebook as a page: its text, its code, and the outputs that are stored in it."""
    blocks = []
    for cell in json.loads(notebook.read_text())["cells"]:
        source = "".join(cell["source"])
        blocks.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            text = "".join(output.get("text", data.get("text/plain", ""))).rstrip()
            if picture := data.get("image/png"):
                blocks.append(f"![What the code plots](data:image/png;base64,{picture.strip()})")
            elif text:
                blocks.append(f"```output\n{text}\n```")
    return "\n\n".join(blocks)


def format_options() -> Iterator[str]:
    """Format the page of all options of the commands, and of all fields of an experiment."""
    yield "# All options\n\nThis page is made from the code: each command's `--help-all`, and the"
    yield "fields of an experiment as `--help-fields GROUP` gives them.\n"
    subparsers = make_parser(help_all=True)._subparsers
    (action,) = subparsers._group_actions
    for group, names in GROUPS.items():
        yield f"## Commands: {group}\n"
        for name in names:
            text = argparse.ArgumentParser.format_help(action.choices[name])
            yield f"### {name}\n\n```output\n{text.rstrip()}\n```\n"
    yield "## Fields of an experiment\n"
    for group in list_group_names():
        title = f"--{group}." if group else "no group"
        yield f"### {title}\n\n```output\n{format_field_help(group)}\n```\n"


def on_page_markdown(text: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Change links to lead from the site's folder: all pages but notebooks lie where docs/ does."""
    if page.file.src_uri.startswith("notebooks/"):
        return text
    text = text.replace("](../", "](").replace("](docs/", "](").replace(".ipynb)", ".md)")
    text = text.replace("](README.md", f"]({TOP['README.md']}")
    text = re.sub(
        r"\]\(((?:examples|experiments|jaxunshear)/[\w/.]+\.(?:py|cpp))\)", r"](\1.txt)", text
    )
    return re.sub(
        r"\[([^\]]+)\]\((?:jaxunshear/models/fast/compiled|LICENSE|CITATION\.cff)\)",
        r"\1",
        text,
    )
