"""The report of a run: one HTML page, made from the files that evaluation wrote."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from markupsafe import Markup

from jaxunshear.config.registry import TRAINABLE
from jaxunshear.errors import UserError
from jaxunshear.evaluation.recorded_results import describe_test
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
from jaxunshear.report.history import History, read_history
from jaxunshear.results.measurement import TrainingSummary
from jaxunshear.results.record_files import read_record
from jaxunshear.results.run import EVALUATE_REMEDY, Results
from jaxunshear.results.times import read_times

SIMULATED_TEXT = Markup(
    "A soft dome that slides over an edge feels its own shear on top of the shape. The networks of "
    "this run turn such an image into the one a plain tap would have given. Every figure of ours "
    "is measured on <b>simulated</b> contacts at poses kept out of training; the paper's, in "
    "<span class=real>tinted columns</span>, are from a <b>real</b> sensor."
)
RECORDED_TEXT = Markup(
    "A soft dome that slides feels its own shear on top of what it touches. {} Every figure is "
    "measured on <b>recorded</b> contacts of a <b>real</b> sensor that were kept out of training: "
    "{} ({}).{}"
)
PAPER_TEXT = Markup(
    " The paper's, in <span class=real>tinted columns</span>, are from another real sensor."
)


class Trainings(NamedTuple):
    """The logs and the summaries of a run's trainings, by network."""

    histories: dict[str, History]
    summaries: dict[str, TrainingSummary]


def write_report(run_dir: Path) -> Path:
    """Write `report.html` and `montage.png` into `run_dir` and return the path of the page.

    A missing log leaves out its curves. Recorded runs that unshear nothing have no montage.
    Raises UserError if the run has not been evaluated or its files are damaged.
    """
    run_dir = Path(run_dir)
    results = read_record(run_dir / "results.json", Results, EVALUATE_REMEDY)
    results = replace(results, time_s={**results.time_s, **read_times(run_dir)})
    trainings = _read_trainings(run_dir)
    try:
        images = None
        if results.simulated or results.ms_ssim:
            images = montage.read_montage(run_dir / "montage.npz")
        sections = list(filter(None, _build_sections(run_dir, results, images, trainings)))
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{run_dir / 'results.json'} lacks {error}: {EVALUATE_REMEDY}") from error
    if images:
        write_bytes(run_dir / "montage.png", montage.plot_montage(images, results))
    path = run_dir / "report.html"
    write_text(path, html.page(f"jaxunshear: {results.experiment}", *sections))
    return path


def _read_trainings(run_dir: Path) -> Trainings:
    trainings = Trainings({}, {})
    for name in TRAINABLE:
        history = read_history(run_dir / name / "log.jsonl")
        if history is None:
            continue
        trainings.histories[name] = history
        summary = run_dir / name / "summary.json"
        if summary.exists():
            remedy = training_sections.RETRAIN_REMEDY
            trainings.summaries[name] = read_record(summary, TrainingSummary, remedy)
    return trainings


def _build_sections(
    run_dir: Path,
    results: Results,
    images: montage.MontageImages | None,
    trainings: Trainings,
) -> Iterator[Markup]:
    """Yield the sections in the order of the page; empty ones have nothing to show."""
    lead = SIMULATED_TEXT if results.simulated else _describe_recorded_run(results)
    yield html.opening(results.experiment, results.claim, lead)
    yield headlines.build_headlines(results)
    if images:
        yield montage.build_section(images, results)
    yield score_sections.build_similarity_section(results)
    yield pose_section.build_pose_section(results)
    yield score_sections.build_estimators_section(results)
    yield score_sections.build_further_tests(results)
    yield score_sections.build_pin_section(results)
    if not results.simulated:
        yield from recordings_section.build_sections(results)
    yield score_sections.build_swap_section(results)
    yield from applications.build_sections(run_dir)
    yield training_sections.build_training_section(*trainings)
    yield training_sections.build_times_section(results, trainings.histories)
    yield training_sections.build_contacts_section(results)
    yield training_sections.build_provenance_section(results)


def _describe_recorded_run(results: Results) -> Markup:
    counts = results.counts
    networks = (
        "Nothing is unsheared here, for which it takes taps and slides: the networks of this run "
        "read poses."
    )
    if results.ms_ssim:
        images = "pins" if labels.uses_pins(results) else "an image"
        networks = (
            f"The networks of this run turn {images} of a slide into what a plain tap would have "
            "given."
        )
    contacts = {"taps": counts.test_taps, "slides": counts.test_poses}
    contact_text = " and ".join(f"{count} {kind}" for kind, count in contacts.items() if count)
    paper = PAPER_TEXT if results.ms_ssim and labels.is_comparable(results) else ""
    return RECORDED_TEXT.format(networks, contact_text, describe_test(results), paper)
