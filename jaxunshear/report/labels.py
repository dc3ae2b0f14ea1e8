"""What the page of a run calls things, determined from its `results.json`: kinds of contacts, quantities, partners."""

from markupsafe import Markup

from jaxunshear.config.registry import REGISTRY, UNSHEARING
from jaxunshear.config.targets import RECORDED_FIELDS
from jaxunshear.results.run import Results, Tables

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
RECORDED_KINDS = {
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
EDGE = ("edge_mm", "edge_deg")  # what an edge does not leave open
MAX_CARDS = 3  # quantities that have a card, at most


def reads_pins(results: Results) -> bool:
    """Whether the networks read pins: images are then pins, drawn."""
    return results.settings["unshear"].get("input") == "pins"


def name_target(results: Results) -> str:
    """What an unsheared slide should be: a tap of the same pose, or whatever stands for one."""
    return (
        "partner"
        if results.pairing and results.pairing.way in ("rendered", "nearest", "simulated")
        else "tap"
    )


def is_comparable(results: Results) -> bool:
    """Whether the paper's likenesses are of the same quantity: images, compared with taps."""
    return results.simulated or (name_target(results) == "tap" and not reads_pins(results))


def name_kind(results: Results, kind: str) -> str:
    """A kind of contact in words, plain text."""
    return KINDS[kind] if results.simulated else RECORDED_KINDS.get(kind) or KINDS[kind]


def list_targets(results: Results) -> list[str]:
    """The quantities that the run's PoseNets read, in its order."""
    if results.targets is not None:
        return [target.name for target in results.targets]
    return list(results.baselines["pose_chance"])


def list_main_targets(results: Results) -> list[str]:
    """Those that the page opens with."""
    names = list_targets(results)
    return [name for name in EDGE if name in names] or names[:MAX_CARDS]


def name_quantity(name: str) -> str:
    """A quantity without its unit."""
    return QUANTITIES.get(name, name.rpartition("_")[0])


def get_unit(name: str) -> str:
    return name.rpartition("_")[2]


def format_heading(name: str) -> Markup:
    """Of a column."""
    return Markup("{}<br>{}").format(name_quantity(name), get_unit(name))


def choose_digits(results: Results, name: str) -> int:
    """Of an error: a real sensor's pins determine some lengths to a few hundredths of a mm."""
    return 2 if results.simulated or get_unit(name) != "mm" else 3


def describe_intervals(results: Tables) -> str:
    """What brackets mean, plain text: intervals of one run know nothing of other trainings. Its end is a full stop."""
    what = f"brackets: {results.spread.what}."
    over = results.spread.over
    return f"{what} Intervals are over {over} and say nothing of other trainings." if over else what
