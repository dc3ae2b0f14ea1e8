"""What an experiment can ask for: the rules of each of its settings, then those between them.

Nothing is simulated or trained, so a refusal takes no time.
"""

from collections.abc import Iterator

from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import format_value
from jaxunshear.config.rules_recorded import list_recorded_rules
from jaxunshear.config.rules_simulated import list_simulated_rules
from jaxunshear.config.types import Rule, check_types, get_value, list_declared_rules
from jaxunshear.errors import UserError


def validate(experiment: Experiment) -> None:
    """Refuse, by dotted name and with a remedy, settings that no run could work with."""
    check_types(experiment)
    for rule in list_rules(experiment):
        if not rule.holds:
            value = format_value(get_value(experiment, rule.field))
            raise UserError(f"--{rule.field} {value}: {rule.remedy}")


def list_rules(experiment: Experiment) -> Iterator[Rule]:
    """Yield all rules for `experiment`; the first that does not hold is the one to report."""
    yield from list_declared_rules(experiment)
    if isinstance(experiment.paired, PairedData) and isinstance(experiment.pose, PoseData):
        yield from list_simulated_rules(experiment, experiment.paired, experiment.pose)
    else:
        yield from list_recorded_rules(experiment)
