"""The table of README on real skin, from docs/results: `python docs/make_tables.py` prints it; a test compares."""

import json
from pathlib import Path

RESULTS = Path(__file__).parent / "results"
COLUMNS = (("y_mm", 2), ("Rz_deg", 1))
ROWS = {
    "taps": ("taps: pose/tap", "tap"),
    "slides as recorded": ("pose/sheared", "sheared"),
    "**slides unsheared**": ("pose/disentangled", "unsheared"),
    "slides, by a PoseNet that learnt from labelled slides": ("pose/sheared_learnt", "sheared_learnt"),
}


def real_skin() -> str:
    """Errors over pins (three seeds) and over images (one), each with its 95 % interval."""
    pins = json.loads((RESULTS / "recorded_pins.json").read_text())["cells"][0]["metrics"]
    images = json.loads((RESULTS / "recorded_images.json").read_text())
    spread = images["spread"]
    lines = [
        "| a PoseNet that learnt from taps reads | pins: y, mm | pins: Rz, deg | images: y, mm | images: Rz, deg |",
        "|---|---|---|---|---|",
    ]
    for name, (over_pins, over_images) in ROWS.items():
        cells = [_cell(pins[f"{over_pins}/{q}"]["mean"], pins[f"{over_pins}/{q}"]["interval"], d) for q, d in COLUMNS]
        cells += [_cell(images["pose_mae"][over_images][q], spread["pose_mae"][over_images][q], d) for q, d in COLUMNS]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    undone = [pins[f"pose_recovery/disentangled/{q}"] for q, _ in COLUMNS]
    cells = [_cell(each["mean"], each["interval"], 2) for each in undone]
    recovery = (images["pose_recovery"]["unsheared"], spread["pose_recovery"]["unsheared"])
    cells += [_cell(recovery[0][q], recovery[1][q], 2) for q, _ in COLUMNS]
    lines.append(f"| recovery: the share of the slide's damage undone | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(value: float, interval: list[float], digits: int) -> str:
    low, high = interval
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


if __name__ == "__main__":
    print(real_skin())
