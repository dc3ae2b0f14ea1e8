"""What an experiment can and cannot ask for: its settings' own rules, then those between them.

Nothing is computed, so a refusal takes no time.
"""

from collections.abc import Iterator

from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import format_value
from jaxunshear.config.rules_recorded import list_recorded_rules
from jaxunshear.config.rules_simulated import list_simulated_rules
from jaxunshear.config.types import Rule, check_types, get_value, list_own_rules
from jaxunshear.errors import UserError


def validate(experiment: Experiment) -> None:
    """Refuses values no run could work with, by dotted name and with a remedy: sizes, ranges, counts, unknown names."""
    check_types(experiment)
    for holds, name, complaint in list_rules(experiment):
        if not holds:
            raise UserError(f"--{name} {format_value(get_value(experiment, name))}: {complaint}")


def list_rules(experiment: Experiment) -> Iterator[Rule]:
    """All rules for `experiment`; the first that does not hold is the one to report."""
    yield from list_own_rules(experiment)
    if isinstance(experiment.paired, PairedData) and isinstance(experiment.pose, PoseData):
        yield from list_simulated_rules(experiment, experiment.paired, experiment.pose)
    else:
        yield from list_recorded_rules(experiment)
