"""Tables of a page as CSV and LaTeX, and its plots as PDF."""

import csv
import re

from jaxunshear.report.html import format_with_interval, page, section, table
from jaxunshear.report.tables import write_tables

PLAIN = [["error", "y mm", "share of 5 %"], ["sheared & <raw>", "0.740 [0.700, 0.780]", "\u2013"]]


def test_a_table_is_written_as_csv_and_latex(tmp_path):
    interval = format_with_interval(0.74, (0.7, 0.78), 3)
    made = table(PLAIN[0], [[PLAIN[1][0], interval, PLAIN[1][2]]])
    file = tmp_path / "page.html"
    file.write_text(page("Title", section("Pose errors", "text", made, made)))
    files = write_tables(file, tmp_path / "tables")
    names = ["pose-errors.csv", "pose-errors.tex", "pose-errors-2.csv", "pose-errors-2.tex"]
    assert [path.name for path in files] == names
    assert list(csv.reader(files[0].read_text().splitlines())) == PLAIN
    assert files[1].read_text() == (
        "\\begin{tabular}{lrr}\n\\toprule\n"
        "error & y mm & share of 5 \\% \\\\\n\\midrule\n"
        "sheared \\& \\textless{}raw\\textgreater{} & 0.740 [0.700, 0.780] & -- \\\\\n"
        "\\bottomrule\n\\end{tabular}\n"
    )


def test_report_writes_all_tables_of_its_page(command, made_up_run, tmp_path):
    run, _ = made_up_run
    assert command("report", run, "--tables", tmp_path / "tables").code == 0
    names = {path.stem for path in (tmp_path / "tables").iterdir()}
    headings = set(re.findall(r'<h2 id="(.*?)">', (run / "report.html").read_text()))
    assert names and {re.sub(r"-\d+$", "", name) for name in names} <= headings
    refused = command("report", run, "--tables", run / "results.json")
    assert refused.code == 2 and "--tables" in refused.err


def test_report_writes_the_plots_of_its_page_as_pdf(command, made_up_run, tmp_path):
    run, _ = made_up_run
    answer = command("report", run, "--figures", tmp_path / "figures")
    files = sorted((tmp_path / "figures").iterdir())
    assert answer.code == 0 and f"{len(files)} figures: " in answer.out
    page = (run / "report.html").read_text()
    assert len(files) >= page.count("data:image/svg+xml") > 0
    for file in files:
        assert file.suffix == ".pdf" and file.read_bytes().startswith(b"%PDF")
        heading = re.sub(r"-\d+$", "", file.stem)
        assert f'<h2 id="{heading}">' in page
    refused = command("report", run, "--figures", run / "results.json")
    assert refused.code == 2 and "--figures" in refused.err
