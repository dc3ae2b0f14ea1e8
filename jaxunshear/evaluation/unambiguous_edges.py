"""Score the edge angle where it is unambiguous: where the nearest edge has one direction.

scores = mark_smooth(scores, settings)            # adds the label SMOOTH
part = score_edge_angles(scores, poses, seed)     # `pose_smooth` of the results
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


def mark_smooth(collected: CollectedScores, settings: PairedData) -> CollectedScores:
    """Add the label SMOOTH (N,): whether the nearest edge has one direction."""
    labels = collected.labels
    smooth = has_one_edge(settings.stimuli, labels["stimulus"], labels["pose"])
    return collected._replace(labels=labels | {SMOOTH: smooth})


def score_edge_angles(collected: CollectedScores, poses: np.ndarray, seed: int) -> PartPoses | None:
    """Tabulate the errors of edge angles over the contacts that are marked SMOOTH.

    `poses` (N,) are the poses that the contacts belong to. None if no contact is marked, or no edge
    angle is predicted.
    """
    angles = {
        name: score
        for name, score in collected.scores.items()
        if name.startswith("pose/") and name.endswith(f"/{EDGE}")
    }
    inside = collected.labels.get(SMOOTH)
    return tabulate_part(angles, inside, poses, seed) if angles and inside is not None else None
