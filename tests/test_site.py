"""`make docs` makes pages that need no network, without warnings or broken links."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FETCHED = r'<(?:script|img|link rel="stylesheet")[^>]*(?:src|href)="(https?://[^"]+)"'


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    words = f"-m mkdocs build --strict --quiet --site-dir {folder}".split()
    here = {"cwd": ROOT, "env": os.environ | {"NO_MKDOCS_2_WARNING": "1"}}
    done = subprocess.run([sys.executable, *words], **here, capture_output=True, text=True)
    assert done.returncode == 0 and not done.stdout, done.stdout + done.stderr
    return folder


def test_every_document_is_a_page(site):
    pages = {path.stem for path in ROOT.glob("docs/*.md")} | {"index", "CONTRIBUTING", "CHANGELOG"}
    assert pages <= {path.stem for path in site.glob("*.html")}
    text = (site / "api.html").read_text()
    assert "load_model" in text and "ms_ssim" in text


def test_a_notebook_is_a_page_with_its_plots(site):
    for notebook in ROOT.glob("docs/notebooks/*.ipynb"):
        text = (site / "notebooks" / f"{notebook.stem}.html").read_text()
        plots = notebook.read_text().count('"image/png"')
        assert text.count('src="data:image/png;base64,') == plots
    assert 'href="notebooks/unshear.html"' in (site / "python.html").read_text()


def test_links_and_pictures_lead_to_files(site):
    for page in (*site.glob("*.html"), *site.glob("notebooks/*.html")):
        for link in re.findall(r'(?:href|src)="([^"#?]+)', page.read_text()):
            outside = "://" in link or link.startswith(("mailto:", "data:"))
            if not outside and page.name != "404.html":
                assert (page.parent / link).exists(), f"{page.name}: {link}"


def test_nothing_is_fetched_from_elsewhere(site):
    assert not {
        found for page in site.glob("*.html") for found in re.findall(FETCHED, page.read_text())
    }
