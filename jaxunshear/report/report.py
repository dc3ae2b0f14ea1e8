"""The report of a run: one HTML page, made from the files that evaluation wrote."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from markupsafe import Markup

from jaxunshear.errors import UserError
from jaxunshear.files import write_bytes, write_text
from jaxunshear.report import (
    applications,
    headlines,
    html,
    montage,
    pose_section,
    recordings_section,
    score_sections,
    training_sections,
    wording,
)
from jaxunshear.report.history import Trainings, read_trainings
from jaxunshear.report.wording import Wording
from jaxunshear.results.record_files import read_record, read_times
from jaxunshear.results.run import EVALUATE_REMEDY, Results


def write_report(run_dir: Path) -> Path:
    """Write `report.html` and `montage.png` into `run_dir` and return the path of the page.

    A missing log leaves out its curves. Runs that unshear nothing have no montage. Raises UserError
    if the run has not been evaluated or its files are damaged.
    """
    run_dir = Path(run_dir)
    results = read_record(run_dir / "results.json", Results, EVALUATE_REMEDY)
    results = replace(results, time_s={**results.time_s, **read_times(run_dir)})
    trainings = read_trainings(run_dir)
    try:
        words = wording.describe(results)
        images = montage.read_montage(run_dir / "montage.npz") if results.ms_ssim else None
        shown = montage.build_section(images, words) if images else Markup()
        sections = list(_build_sections(run_dir, results, words, shown, trainings))
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{run_dir / 'results.json'} lacks {error}: {EVALUATE_REMEDY}") from error
    if images:
        write_bytes(run_dir / "montage.png", montage.plot_montage(images, words))
    path = run_dir / "report.html"
    write_text(path, html.page(f"jaxunshear: {results.experiment}", *filter(None, sections)))
    return path


def _build_sections(
    run_dir: Path, results: Results, words: Wording, shown: Markup, trainings: Trainings
) -> Iterator[Markup]:
    """Yield the sections in the order of the page; empty ones have nothing to show."""
    yield html.opening(results.experiment, results.claim, wording.write_lead(results, words))
    yield headlines.build_headlines(results, words)
    yield shown
    yield score_sections.build_similarity_section(results, words)
    yield pose_section.build_pose_section(results, words)
    yield score_sections.build_estimators_section(results, words)
    yield score_sections.build_further_tests(results, words)
    yield score_sections.build_pin_section(results, words)
    yield recordings_section.build_recordings_section(results)
    yield recordings_section.build_pairing_section(results, words)
    yield recordings_section.build_bounds_section(results, words)
    yield score_sections.build_swap_section(results, words)
    yield from applications.build_sections(run_dir)
    yield training_sections.build_training_section(trainings)
    yield training_sections.build_times_section(results, words, trainings)
    yield training_sections.build_contacts_section(results)
    yield training_sections.build_provenance_section(results)
