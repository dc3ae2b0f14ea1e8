"""Words on a run's page for kinds of contacts, quantities and targets."""

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
EDGE = ("edge_mm", "edge_deg")  # unlike x and yaw, these are not ambiguous along an edge
MAX_CARDS = 3  # quantities with a card, at most


def uses_pins(results: Results) -> bool:
    """Say whether the networks take pins; the images of the run are then drawings of pins."""
    return results.settings["unshear"].get("input") == "pins"


def name_target(results: Results) -> str:
    """Name the target of unshearing: a tap at the same pose, or the partner in its place."""
    pairing = results.pairing.way if results.pairing else ""
    return "partner" if pairing in ("rendered", "nearest", "simulated") else "tap"


def is_comparable(results: Results) -> bool:
    """Say whether the paper's likenesses are the same quantity: images compared with taps."""
    return results.simulated or (name_target(results) == "tap" and not uses_pins(results))


def name_kind(results: Results, kind: str) -> str:
    """Name a kind of contact in plain text."""
    return KINDS[kind] if results.simulated else RECORDED_KINDS.get(kind) or KINDS[kind]


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


def choose_digits(results: Results, name: str) -> int:
    """Choose the decimals of an error; the pins of a real sensor show hundredths of a mm."""
    return 2 if results.simulated or get_unit(name) != "mm" else 3


def choose_target_digits(results: Results) -> dict[str, int]:
    """Give the decimals of the error in each quantity of `list_targets`, by its name."""
    return {name: choose_digits(results, name) for name in list_targets(results)}


def describe_intervals(results: Tables) -> str:
    """Say in plain text what brackets mean and which variation they leave out."""
    meaning, over = f"brackets: {results.spread.what}.", results.spread.over
    if not over:
        return meaning
    return f"{meaning} Intervals are over {over} and say nothing of other trainings."
