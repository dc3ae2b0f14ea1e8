"""What weights may know of a test: determined by the origins of their data alone, before anything is simulated or trained. Imports no JAX.

An origin is the description of a set as it stands in model.json: {"set": ..., "version": ..., "settings": {...}}.
"""

from typing import NamedTuple

from jaxunshear.dataset.digests import folders_in, pairs_in
from jaxunshear.settings.configs import RECORDED_SET, set_name, version_of
from jaxunshear.settings.data import PairedData, Recorded
from jaxunshear.settings.experiment import Experiment, further_tests
from jaxunshear.settings.stimuli import stimulus_names
from jaxunshear.storage import Json

BY_POSE = 3  # major version of the simulated data since which a pose's split is its own
Origin = Json


class Exam(NamedTuple):
    """A set that networks are scored on."""

    settings: PairedData | Recorded
    entire: bool = False  # all of it is for the test, not the split of that name alone
    new_shapes: bool = False  # the test's point is that nobody has seen its stimuli


def exams_of(experiment: Experiment) -> list[Exam]:
    """The sets that the networks of an experiment are scored on."""
    further = further_tests(experiment).items()
    return [Exam(experiment.paired), *(Exam(settings, True, name == "unseen") for name, settings in further)]


def known(origin: Origin, exam: Exam) -> str:
    """Why weights that learnt from `origin` may know contacts that are tested, and what to do; empty where they cannot.

    Other seeds draw other poses. Sets of one seed share their poses: since data version 3 also their splits. Recordings are the same
    where a folder's digest is; of other folders nothing can be determined, and they are taken for others.
    """
    if isinstance(exam.settings, Recorded):
        return _recorded(origin, exam.settings, exam.entire) if origin["set"] == RECORDED_SET else ""
    return _simulated(origin, exam.settings, exam) if origin["set"] != RECORDED_SET else ""


def _simulated(origin: Origin, ours: PairedData, exam: Exam) -> str:
    theirs = origin["settings"]
    shapes = ", ".join(name for name in ours.names if name in stimulus_names(theirs["stimuli"]))
    if not shapes:
        return ""
    learnt = (
        f"learnt from {origin['set']} {origin['version']} of seed {theirs['seed']} ({theirs['poses']} poses a shape)"
    )
    if exam.new_shapes:
        return f"{learnt}, and knows {shapes}, which --unseen tests as new: leave them out there, or use other weights"
    if theirs["seed"] != ours.seed:
        return ""
    test = f"{set_name(ours)} {version_of(ours)} of seed {ours.seed} is tested"
    if exam.entire:
        return f"{learnt}, and all of {test}: use another --paired.seed, or other weights"
    if _major(origin["version"]) >= BY_POSE:
        return ""
    return (
        f"{learnt}, and {test}: before version {BY_POSE}.0.0 each size of a set had splits of its own, so that these weights may know "
        f"test poses; use another --paired.seed, or weights of data version {BY_POSE}.0.0 or later"
    )


def _recorded(origin: Origin, ours: Recorded, entire: bool) -> str:
    theirs = origin["settings"]
    shared = folders_in(theirs["digest"]) & folders_in(ours.digest)
    if not shared:
        return ""
    learnt = f"learnt from recordings that are tested (digest {', '.join(sorted(shared))})"
    if entire:
        return f"{learnt}: test on others, or use weights that have not seen them"
    names = [name for name in ("split", "seed", "test", "validation") if theirs[name] != getattr(ours, name)]
    other = [f"paired.{name} {theirs[name]}" for name in names]
    other += ["another table of pairs"] if pairs_in(theirs["digest"]) != pairs_in(ours.digest) else []
    other += [f"data version {origin['version']}"] if origin["version"] != version_of(ours) else []
    return f"{learnt}, split with {', '.join(other)}: split them alike, or use other weights" if other else ""


def _major(version: str) -> int:
    """0 where it is not known."""
    first = version.partition(".")[0]
    return int(first) if first.isdigit() else 0
