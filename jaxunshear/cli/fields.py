"""Help on the fields of a group of settings, for `--help-fields GROUP`."""

import dataclasses
from collections.abc import Iterator
from textwrap import wrap

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import NOT_SETTABLE, format_value
from jaxunshear.config.types import describe_hint, get_origin, list_choices, list_groups, list_hints
from jaxunshear.errors import UserError

FLAG = "--help-fields"
WIDTH = 100


def split_help_request(argv: list[str]) -> tuple[str, list[str]] | None:
    """Return the group that a command line asks about, and its other words; or None."""
    for place, word in enumerate(argv):
        name, equals, value = word.partition("=")
        if name == FLAG:
            rest = argv[place + 1 :]
            group = value if equals else next(iter(rest), "")
            return group, argv[:place] + (rest if equals else rest[1:])
    return None


def list_group_names() -> tuple[str, ...]:
    """List the groups of fields that an experiment can have; '' for the fields of no group."""
    return tuple(dict(_list_groups(Experiment, "")))


def format_field_help(group: str, experiment: Experiment | None = None) -> str:
    """Say of each field of a group its value, what it takes and what it means.

    Values are those of `experiment`, or the usual ones. Raises UserError for a group that there is
    not, or not in this experiment.
    """
    groups = dict(_list_groups(Experiment, ""))
    if group not in groups:
        names = ", ".join(filter(None, groups))
        raise UserError(f"{FLAG} {group}: name one of {names}, or '' for those of no group")
    settings: object = experiment or Experiment(name="", claim="")
    for part in filter(None, group.split(".")):
        if not hasattr(settings, part):
            raise UserError(
                f"{FLAG} {group}: this experiment has no {part} there: "
                f"its {type(settings).__name__} has other fields"
            )
        settings = getattr(settings, part)
    owners: dict[str, list[type]] = {}  # kinds of settings by the field that they have
    for kind in [type(settings)] if experiment else groups[group]:
        for name, hint in list_hints(kind).items():
            is_sensor = group == "" and name == "sensor"
            if name not in NOT_SETTABLE and (is_sensor or not list_groups(hint)):
                owners.setdefault(name, []).append(kind)
    prefix = f"{group}." if group else ""
    return "\n".join(
        f"--{prefix}{_format_field(name, kinds, settings)}" for name, kinds in owners.items()
    )


def _list_groups(kind: type, name: str) -> Iterator[tuple[str, list[type]]]:
    """Yield groups by dotted name, with the kinds of settings that each may hold."""
    yield name, [kind]
    for field, hint in list_hints(kind).items():
        below = f"{name}.{field}".lstrip(".")
        kinds_by_name: dict[str, list[type]] = {}
        for each in list_groups(hint):
            for inner, kinds in _list_groups(each, below):
                kinds_by_name.setdefault(inner, []).extend(kinds)
        yield from kinds_by_name.items()


def _format_field(name: str, kinds: list[type], settings: object) -> str:
    """Format the help on one field, which several kinds of settings may have."""
    values = " or ".join(dict.fromkeys(_format_value(name, kind, settings) for kind in kinds))
    meanings = {kind.__name__: _read_meaning(kind, name) for kind in kinds}
    meaning = next(iter(meanings.values()))
    if len(set(meanings.values())) > 1:
        meaning = " ".join(
            f"Of {kind}: {text[:1].lower()}{text[1:]}." for kind, text in meanings.items()
        )
    hint = list_hints(kinds[0])[name]
    is_list, choices = get_origin(hint) is tuple, ", ".join(list_choices(hint))
    accepted = f"some of {choices}" if is_list and choices else describe_hint(hint)
    text = f"{accepted}. {meaning}".rstrip()
    lines = wrap(text, WIDTH, initial_indent=" " * 4, subsequent_indent=" " * 4)
    return "\n".join([f"{name} {values}", *lines])


def _format_value(name: str, kind: type, settings: object) -> str:
    if isinstance(settings, kind):
        return format_value(getattr(settings, name))
    field = {each.name: each for each in dataclasses.fields(kind)}[name]
    if field.default_factory is not dataclasses.MISSING:
        return format_value(field.default_factory())
    return "" if field.default is dataclasses.MISSING else format_value(field.default)


def _read_meaning(kind: type, field: str) -> str:
    """Read the comment beside or above the field's definition."""
    # imported only for this: the command line starts quickly
    from simple_parsing.docstring import get_attribute_docstring

    owner = next(
        base for base in reversed(kind.__mro__) if field in vars(base).get("__annotations__", {})
    )
    docstring = get_attribute_docstring(owner, field)
    text = " ".join((docstring.comment_inline or docstring.comment_above).split())
    return text[:1].upper() + text[1:]
