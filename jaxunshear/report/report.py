"""The report of a run: one HTML page that a person understands at a glance, from the files that evaluation left.

Read `write_report` for the order of the page.
"""

from dataclasses import replace
from pathlib import Path

from markupsafe import Markup

from jaxunshear.config.registry import TRAINABLE
from jaxunshear.errors import UserError
from jaxunshear.evaluation.recorded_descriptions import describe_test
from jaxunshear.files import write_bytes, write_text
from jaxunshear.report import (
    applications,
    headlines,
    html,
    labels,
    montage,
    pose_section,
    recordings_section,
    score_sections,
    training_sections,
)
from jaxunshear.report.history import read_history
from jaxunshear.results.measurement import TrainingSummary
from jaxunshear.results.record_files import read_record
from jaxunshear.results.run import EVALUATE_REMEDY, Results
from jaxunshear.results.times import read_times

SIMULATED_TEXT = Markup(
    "A soft dome that slides over an edge feels its own shear on top of the shape. The networks of "
    "this run turn such an image into the one a plain tap would have given. Every figure of ours is measured on "
    "<b>simulated</b> contacts at poses kept out of training; the paper's, in "
    "<span class=real>tinted columns</span>, are from a <b>real</b> sensor."
)
RECORDED_TEXT = Markup(
    "A soft dome that slides feels its own shear on top of what it touches. {} Every figure is measured on "
    "<b>recorded</b> contacts of a <b>real</b> sensor that were kept out of training: {} ({}).{}"
)
PAPER_TEXT = Markup(
    " The paper's, in <span class=real>tinted columns</span>, are from another real sensor."
)


def write_report(run_dir: Path) -> Path:
    """Writes `report.html` and `montage.png` from `results.json`, `montage.npz`, `times.json` and the networks' `log.jsonl` in `run_dir`.

    Raises `UserError` where the run has not been evaluated or its files are damaged. Missing logs leave out their
    curves; recorded runs in which nothing is unsheared have no montage.
    """
    run_dir = Path(run_dir)
    results = read_record(run_dir / "results.json", Results, EVALUATE_REMEDY)
    grown = read_times(run_dir)  # since the evaluation
    results = replace(results, time_s={**results.time_s, **grown})
    logs = {name: read_history(run_dir / name / "log.jsonl") for name in TRAINABLE}
    histories = {name: history for name, history in logs.items() if history}
    endings = {name: run_dir / name / "summary.json" for name in histories}
    summaries = {
        name: read_record(path, TrainingSummary, training_sections.RETRAIN_REMEDY)
        for name, path in endings.items()
        if path.exists()
    }
    try:
        shown = (
            montage.read_montage(run_dir / "montage.npz")
            if results.simulated or results.ms_ssim
            else None
        )
        parts = [
            _heading(results),
            headlines.build_headlines(results),
            montage.build_section(shown, results) if shown else "",
            score_sections.build_similarity_section(results),
            pose_section.build_pose_section(results),
            score_sections.readers(results),
            score_sections.build_further_tests(results),
            score_sections.build_pin_section(results),
            *(
                []
                if results.simulated
                else [
                    recordings_section.build_recordings_section(results),
                    recordings_section.build_pairing_section(results),
                    recordings_section.build_intervals_section(results),
                ]
            ),
            score_sections.build_swap_section(results),
            *applications.build_sections(run_dir),
            training_sections.build_training_section(histories, summaries),
            training_sections.build_times_section(results, histories),
            training_sections.build_contacts_section(results),
            training_sections.build_provenance_section(results),
        ]
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{run_dir / 'results.json'} lacks {error}: {EVALUATE_REMEDY}") from error
    if shown:
        write_bytes(run_dir / "montage.png", montage.plot_montage(shown, results))
    path = run_dir / "report.html"
    write_text(path, html.page(f"jaxunshear: {results.experiment}", *filter(None, parts)))
    return path


def _heading(results: Results) -> Markup:
    lead = SIMULATED_TEXT if results.simulated else _describe_recordings(results)
    return html.opening(results.experiment, results.claim, lead)


def _describe_recordings(results: Results) -> Markup:
    counts = results.counts
    if results.ms_ssim:
        what = "pins" if labels.reads_pins(results) else "an image"
        about = f"The networks of this run turn {what} of a slide into what a plain tap would have given."
    else:
        about = "Nothing is unsheared here, for which it takes taps and slides: the networks of this run read poses."
    counted = " and ".join(
        f"{count} {kind}"
        for kind, count in (("taps", counts.test_taps), ("slides", counts.test_poses))
        if count
    )
    paper = PAPER_TEXT if results.ms_ssim and labels.is_comparable(results) else ""
    return RECORDED_TEXT.format(about, counted, describe_test(results), paper)
