"""Errors of the edge's angle where it is unambiguous: the nearest edge has one direction there.

gathered = mark_smooth(gathered, settings)          # adds the label SMOOTH
found = score_edge_angles(gathered, poses, seed)     # `pose_smooth` of the results
"""

import numpy as np

from jaxunshear.config.data import PairedData
from jaxunshear.evaluation.result_tables import tabulate_part
from jaxunshear.evaluation.score_collection import CollectedScores
from jaxunshear.results.run import PartPoses
from jaxunshear.simulator.scene import NEAR_MM, TURN_DEG, has_one_edge

SMOOTH = "smooth"
EDGE = "edge_deg"
SMOOTH_NOTE = (
    f"pose_mae of {EDGE} where the direction of the nearest edge turns by at most {TURN_DEG:g} deg "
    f"within {NEAR_MM:g} mm"
)


def mark_smooth(gathered: CollectedScores, settings: PairedData) -> CollectedScores:
    """Add the label SMOOTH (N,): whether the nearest edge has one direction."""
    smooth = has_one_edge(settings.stimuli, gathered.labels["stimulus"], gathered.labels["pose"])
    return gathered._replace(labels=gathered.labels | {SMOOTH: smooth})


def score_edge_angles(gathered: CollectedScores, poses: np.ndarray, seed: int) -> PartPoses | None:
    """Give what `result_tables.build_tables` says of edge angles, of the contacts that are marked SMOOTH.

    `poses` (N,) are the poses that the contacts belong to. None if no contact is marked, or no edge
    angle is predicted.
    """
    angles = {
        name: score
        for name, score in gathered.scores.items()
        if name.startswith("pose/") and name.endswith(f"/{EDGE}")
    }
    inside = gathered.labels.get(SMOOTH)
    return tabulate_part(angles, inside, poses, seed) if angles and inside is not None else None
