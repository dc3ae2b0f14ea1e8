"""The words for a run's results: what its contacts, targets, columns and pictures are called.

Sections of a page are the same for all runs and ask for words alone; `describe` chooses these from
wording.toml.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from jaxunshear.config.networks import DISENTANGLED, REGISTRY, UNSHEARING
from jaxunshear.config.targets import get_unit
from jaxunshear.evaluation.recorded_results import describe_test
from jaxunshear.files import Json
from jaxunshear.report import html
from jaxunshear.results.record_files import convert_record
from jaxunshear.results.run import FullTable, Results, Tables

FILE = Path(__file__).with_suffix(".toml")
TEXTS: Json = tomllib.loads(FILE.read_text(encoding="utf-8"))
# unlike x and yaw, these are not ambiguous along an edge
QUANTITIES = {"edge_mm": "edge distance", "edge_deg": "edge angle"}
EDGE_NOTE = (
    " x and yaw are ambiguous along a smooth edge; the distance to the edge and its local angle "
    "are not."
)
MAX_CARDS = 3  # quantities with a card, at most


@dataclass(frozen=True)
class ModalityWords:
    """Words for what networks are given and give."""

    input: str
    output: str
    pose_input: str
    drawn: str  # what the images of the run show, if they are drawings
    montage: str


@dataclass(frozen=True, kw_only=True)
class Wording:
    """The words for one run."""

    source: str  # of contacts: begins the names of macros
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
    digits: Mapping[str, int]  # decimals of errors, by target
    main_targets: list[str]  # with which the page begins
    posenet: str
    pin_row: str  # of the target's own pins
    pin_truth: str
    validation_error: str


def describe(results: Results) -> Wording:
    """Choose the words for a run."""
    source = "simulated" if results.simulated else "recorded"
    words = TEXTS[source]
    modality = TEXTS[results.settings["unshear"].get("input", "images")]
    pairing = results.pairing.way if results.pairing else ""
    target = "partner" if pairing in ("rendered", "nearest", "simulated") else "tap"
    papers = {*words["paper_tables"], *(modality["paper_tables"] if target == "tap" else ())}
    filled = {
        "source": source,
        "modality": modality,
        "kinds": list_kinds(words),
        "target": target,
        "paper": {name: table for name, table in results.paper.items() if name in papers},
        "digits": {name: words["digits"].get(get_unit(name), 2) for name in list_targets(results)},
        "main_targets": list_main_targets(results),
        "posenet": _describe_posenet(words["posenet"], results),
    }
    filled |= {name: words[name].format(target=target) for name in ("pin_row", "pin_truth")}
    filled["montage"] = words["montage"].format(target=target) + modality["montage"]
    return convert_record(words | filled, Wording, FILE, "install jaxunshear again")


def list_kinds(words: Json) -> dict[str, str]:
    """List the names of kinds of contact; the networks stand in the place of `network`."""
    kinds: dict[str, str] = {}
    for kind, name in words["kinds"].items():
        if kind == "network":
            kinds |= {network: name.format(REGISTRY[network].title) for network in UNSHEARING}
        else:
            kinds[kind] = name
    return kinds


KINDS = list_kinds(TEXTS["simulated"])


def write_lead(results: Results, words: Wording) -> Markup:
    """Write how the page begins."""
    unsheared = words.modality.input if results.ms_ssim else ""
    counts = {"taps": results.counts.test_taps, "slides": results.counts.test_poses}
    contacts = " and ".join(f"{count} {kind}" for kind, count in counts.items() if count)
    has_paper = bool(results.ms_ssim and words.paper)
    write = html.get_macro(f"{words.source}_lead")
    return write(unsheared, contacts, describe_test(results), has_paper)


def describe_source(results: Results) -> str:
    """Describe the day and the code of the evaluation; nothing if they are unknown."""
    source = results.source
    if source is None:
        return ""
    commit = f", commit {source.commit[:10]}" if source.commit else ""
    changed = " with changes" if source.clean is False else ""
    return f"Evaluated on {source.date} by jaxunshear {source.version}{commit}{changed}."


def _describe_posenet(text: str, results: Results) -> str:
    lessons = "taps."
    if set(results.pose_mae) == {"sheared_learnt"}:
        lessons = "labelled slides."
    elif "sheared_learnt" in results.pose_mae:
        lessons = "taps; one row is of a PoseNet that learned from labelled slides."
    edges = EDGE_NOTE if "edge_mm" in list_targets(results) else ""
    return text.format(lessons=lessons) + edges


def write_recovery(results: Results, network: str, parts: list[str]) -> Markup:
    """Write the recoveries of a network, beside the paper's, which are of another sensor."""
    error, papers = results.paper["pose_mae"], []
    for name, sheared in error["sheared"].items():
        recovery = (sheared - error[DISENTANGLED][name]) / (sheared - error["tap"][name])
        papers.append(f"{recovery:.2f} in {name_quantity(name)}")
    return html.recovery(network, "; ".join(parts), " and ".join(papers))


def list_targets(results: Results) -> list[str]:
    """List the quantities that the run's PoseNets predict, in their order."""
    if results.targets is not None:
        return [target.name for target in results.targets]
    return list(results.baselines["pose_chance"])


def list_main_targets(results: Results) -> list[str]:
    """List the quantities with which the page begins."""
    names = list_targets(results)
    return [name for name in QUANTITIES if name in names] or names[:MAX_CARDS]


def name_quantity(name: str) -> str:
    """Name a quantity without its unit."""
    return QUANTITIES.get(name) or name.removesuffix(f"_{get_unit(name)}").replace("_", " ")


def format_heading(name: str) -> Markup:
    """Format the heading of a quantity's column: its name above its unit."""
    return Markup("{}<br>{}").format(name_quantity(name), get_unit(name))


def section(name: str, *body: object, **facts: object) -> Markup:
    """Build a section of wording.toml; `facts` stand in its title and in its lead."""
    text = TEXTS["sections"][name]
    return html.section(text["title"].format(**facts), text["lead"].format(**facts), *body)


def describe_intervals(results: Tables) -> str:
    """Say in plain text what brackets mean and which variation they leave out."""
    meaning, over = f"brackets: {results.spread.what}.", results.spread.over
    if not over:
        return meaning
    return f"{meaning} Intervals are over {over} and say nothing of other trainings."
