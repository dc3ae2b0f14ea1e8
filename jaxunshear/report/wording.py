"""The words for a run's results: what its contacts, targets, columns and pictures are called.

Sections of a page are the same for all runs and ask for words alone; `describe` chooses these.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from markupsafe import Markup

from jaxunshear.config.registry import DISENTANGLED, REGISTRY, UNSHEARING
from jaxunshear.config.targets import RECORDED_FIELDS
from jaxunshear.evaluation.recorded_descriptions import describe_test
from jaxunshear.results.run import FullTable, Results, Tables

KINDS = {
    "tap": "tap (no slide)",
    "sheared": "sheared, as felt",
    "sheared_learnt": "sheared, PoseNet that learnt slides",
    "mean_tap": "mean of the training taps",
    "nearest_tap": "training tap nearest to the sheared",
    "translated": "sheared, best translation (knows the tap)",
    **{name: f"unsheared, {REGISTRY[name].title}" for name in UNSHEARING},
    "true_slide": "sheared, pins known by name",
}
RECORDED_KINDS = KINDS | {
    "tap": "taps (no slide)",
    "partner": "partners of the slides",
    "sheared": "slides, as felt",
    "sheared_learnt": "slides, learnt from slides directly",
    **{name: f"slides, unsheared ({REGISTRY[name].title})" for name in UNSHEARING},
    "unsheared": "slides, unsheared",
    "true_slide": "slides, pins known by name",
}
QUANTITIES = {
    "x_mm": "x",
    "y_mm": "y",
    "z_mm": "z",
    "yaw_deg": "yaw",
    "depth_mm": "depth",
    "edge_mm": "edge distance",
    "edge_deg": "edge angle",
    "Rx_deg": "Rx",
    "Ry_deg": "Ry",
    "Rz_deg": "Rz",
}
QUANTITIES |= {
    f"slide_{name}": f"slide {word}" for name, word in QUANTITIES.items() if name in RECORDED_FIELDS
}
EDGE = ("edge_mm", "edge_deg")  # unlike x and yaw, these are not ambiguous along an edge
MAX_CARDS = 3  # quantities with a card, at most

SIMULATED_LEAD = Markup(
    "A soft dome that slides over an edge feels its own shear on top of the shape. The networks of "
    "this run turn such an image into the one a plain tap would have given. Every figure of ours "
    "is measured on <b>simulated</b> contacts at poses kept out of training; the paper's, in "
    "<span class=real>tinted columns</span>, are from a <b>real</b> sensor."
)
RECORDED_LEAD = Markup(
    "A soft dome that slides feels its own shear on top of what it touches. {} Every figure is "
    "measured on <b>recorded</b> contacts of a <b>real</b> sensor that were kept out of training: "
    "{} ({}).{}"
)
PAPER_LEAD = Markup(
    " The paper's, in <span class=real>tinted columns</span>, are from another real sensor."
)


@dataclass(frozen=True, kw_only=True)
class ModalityWords:
    """Words for what networks are given and give."""

    input: str
    output: str
    pose_input: str  # head of a column
    drawn: str  # what the images of the run show, if they are drawings
    montage_note: str
    paper_tables: tuple[str, ...]  # the paper's, of the same quantities on a real sensor


MODALITIES = {
    "images": ModalityWords(
        input="an image",
        output="image",
        pose_input="image given to PoseNet",
        drawn="",
        montage_note="",
        paper_tables=("ms_ssim", "swap"),
    ),
    "pins": ModalityWords(
        input="pins",
        output="pins",
        pose_input="what PoseNet is given",
        drawn="of drawn pins",
        montage_note=" The network reads pins and gives pins: the images are these pins, drawn.",
        paper_tables=(),
    ),
}


@dataclass(frozen=True, kw_only=True)
class RecoveryWords:
    """The sentence on recovery, `text`, in which the network and the quantities stand."""

    text: Markup
    separator: str  # of quantities
    form: str  # of a number
    undamaged: str  # of a quantity in which slides do no damage; it is left out if empty


@dataclass(frozen=True, kw_only=True)
class Wording:
    """The words for one run."""

    lead: Markup  # of the page
    modality: ModalityWords
    kinds: Mapping[str, str]  # of contact
    target: str  # of unshearing: the tap at the same pose, or the partner in its place
    paper: Mapping[str, FullTable]  # its tables that have the same quantities
    cards: tuple[str, ...]  # at the top, in their order
    card_notes: Mapping[str, str]  # on errors by kind
    likeness_note: str  # on a card without a bar
    montage: str
    contact: str
    depth: str
    mm_digits: int  # of errors in mm
    posenet: str
    recovery: RecoveryWords
    by_kind: bool  # whether differences are listed by kind of contact instead of by quantity
    pin_row: str  # of the target's own pins
    pin_truth: str
    validation_error: str

    def choose_digits(self, targets: list[str]) -> dict[str, int]:
        """Choose the decimals of the errors in `targets`."""
        return {name: self.mm_digits if get_unit(name) == "mm" else 2 for name in targets}


def describe(results: Results) -> Wording:
    """Choose the words for a run."""
    build = _describe_simulated_run if results.simulated else _describe_recorded_run
    return build(results, get_modality(results))


def get_modality(results: Results) -> ModalityWords:
    """Return the words for the input of the run's networks."""
    return MODALITIES[results.settings["unshear"].get("input", "images")]


def _describe_simulated_run(results: Results, modality: ModalityWords) -> Wording:
    posenet = "Mean absolute error of a PoseNet that has only learned from taps."
    if "edge_mm" in list_targets(results):
        posenet += (
            " x and yaw are ambiguous along a smooth edge; the distance to the edge and its "
            "local angle are not."
        )
    return Wording(
        lead=SIMULATED_LEAD,
        modality=modality,
        kinds=KINDS,
        target="tap",
        paper=results.paper,
        cards=("likeness", "errors", "pins"),
        card_notes={},
        likeness_note="",
        montage="One contact of each shape that is typical of its test set: what was felt, what "
        "the network made of it, and the truth.",
        contact="image",
        depth="depth",
        mm_digits=2,
        posenet=posenet,
        recovery=RecoveryWords(
            text=Markup(
                "<p class=soft>Recovery, the part of the slide's damage that is undone, by the {} "
                "network: {}.</p>"
            ),
            separator=", ",
            form=".0%",
            undamaged="",
        ),
        by_kind=False,
        pin_row=KINDS["tap"],
        pin_truth="tap's true pins",
        validation_error="{} of taps, {}",
    )


def _describe_recorded_run(results: Results, modality: ModalityWords) -> Wording:
    way = results.pairing.way if results.pairing else ""
    target = "partner" if way in ("rendered", "nearest", "simulated") else "tap"
    paper = {name: results.paper[name] for name in modality.paper_tables if target == "tap"}
    return Wording(
        lead=_write_recorded_lead(results, modality, has_paper=bool(paper)),
        modality=modality,
        kinds=RECORDED_KINDS,
        target=target,
        paper=paper,
        cards=("errors", "likeness", "recovery"),
        card_notes={
            "tap": "taps",
            "sheared": "slides, as felt",
            "sheared_learnt": "learnt from slides directly",
        },
        likeness_note="1 is equal",
        montage="A held-out slide that is typical: what was felt, what the network made of it, "
        f"and its {target}.",
        contact="contact",
        depth="z",
        mm_digits=3,  # the pins of a real sensor show hundredths of a mm
        posenet="Mean absolute errors on held-out contacts, in the labels' own frame, of a PoseNet "
        f"that has only learned from {_describe_lessons(results)}",
        recovery=RecoveryWords(
            text=Markup(
                "<p>Recovery, (as felt - unsheared) / (as felt - taps), by the {} network: {}. 1 "
                "is as good as taps, 0 as bad as slides as felt.</p><p class=soft>"
            )
            + _describe_paper_recovery(results)
            + Markup("</p>"),
            separator="; ",
            form=".2f",
            undamaged="none, as slides do no harm",
        ),
        by_kind=True,
        pin_row=target,
        pin_truth=f"{target}'s pins",
        validation_error="error in {}, {}",
    )


def _write_recorded_lead(results: Results, modality: ModalityWords, has_paper: bool) -> Markup:
    networks = (
        "Nothing is unsheared here, for which it takes taps and slides: the networks of this run "
        "read poses."
    )
    if results.ms_ssim:
        networks = (
            f"The networks of this run turn {modality.input} of a slide into what a plain tap "
            "would have given."
        )
    counts = {"taps": results.counts.test_taps, "slides": results.counts.test_poses}
    contacts = " and ".join(f"{count} {kind}" for kind, count in counts.items() if count)
    paper = PAPER_LEAD if results.ms_ssim and has_paper else ""
    return RECORDED_LEAD.format(networks, contacts, describe_test(results), paper)


def _describe_lessons(results: Results) -> str:
    if set(results.pose_mae) == {"sheared_learnt"}:
        return "labelled slides."
    if "sheared_learnt" in results.pose_mae:
        return "taps; one row is of a PoseNet that learned from labelled slides."
    return "taps."


def _describe_paper_recovery(results: Results) -> str:
    """Describe the paper's recoveries, which are of another sensor and give the scale."""
    error, parts = results.paper["pose_mae"], []
    for name, sheared in error["sheared"].items():
        recovery = (sheared - error[DISENTANGLED][name]) / (sheared - error["tap"][name])
        parts.append(f"{recovery:.2f} in {name_quantity(name)}")
    return (
        "The paper's disentangled network, on another sensor and task, has a recovery of "
        f"{' and '.join(parts)}."
    )


def list_targets(results: Results) -> list[str]:
    """List the quantities that the run's PoseNets predict, in their order."""
    if results.targets is not None:
        return [target.name for target in results.targets]
    return list(results.baselines["pose_chance"])


def list_main_targets(results: Results) -> list[str]:
    """List the quantities with which the page begins."""
    names = list_targets(results)
    return [name for name in EDGE if name in names] or names[:MAX_CARDS]


def name_quantity(name: str) -> str:
    """Name a quantity without its unit."""
    return QUANTITIES.get(name, name.rpartition("_")[0])


def get_unit(name: str) -> str:
    """Return the unit in the name of a quantity."""
    return name.rpartition("_")[2]


def format_heading(name: str) -> Markup:
    """Format the heading of a quantity's column: its name above its unit."""
    return Markup("{}<br>{}").format(name_quantity(name), get_unit(name))


def describe_intervals(results: Tables) -> str:
    """Say in plain text what brackets mean and which variation they leave out."""
    meaning, over = f"brackets: {results.spread.what}.", results.spread.over
    if not over:
        return meaning
    return f"{meaning} Intervals are over {over} and say nothing of other trainings."
