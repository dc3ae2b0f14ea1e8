"""Help on the fields of a group of settings, for `--help-fields GROUP`."""

import dataclasses
from collections.abc import Iterator
from textwrap import wrap
from typing import NamedTuple

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


def format_field_help(group: str, experiment: Experiment | None = None) -> str:
    """Say of each field of a group its value, what it takes and what it means.

    Values are those of `experiment`, or the usual ones. Raises UserError for a group that there is
    not, or not in this experiment.
    """
    groups = dict(_list_groups(Experiment, ""))
    if group not in groups:
        names = ", ".join(filter(None, groups))
        raise UserError(f"{FLAG} {group}: name one of {names}, or '' for those of no group")
    settings = _get_group(experiment or Experiment(name="", claim=""), group)
    entries: dict[str, list[_Entry]] = {}
    for kind in [type(settings)] if experiment else groups[group]:
        for entry in _list_entries(kind, settings, f"{group}." if group else ""):
            entries.setdefault(entry.name, []).append(entry)
    return "\n".join(map(_format_entries, entries.values()))


def _get_group(experiment: Experiment, name: str) -> object:
    settings: object = experiment
    for part in filter(None, name.split(".")):
        if not hasattr(settings, part):
            raise UserError(
                f"{FLAG} {name}: this experiment has no {part} there: "
                f"its {type(settings).__name__} has other fields"
            )
        settings = getattr(settings, part)
    return settings


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


class _Entry(NamedTuple):
    name: str
    value: str
    accepted: str
    meaning: str
    kind: str  # of settings that have this field


def _list_entries(kind: type, settings: object, prefix: str) -> Iterator[_Entry]:
    for field in dataclasses.fields(kind):
        hint = list_hints(kind)[field.name]
        if field.name in NOT_SETTABLE or (list_groups(hint) and prefix + field.name != "sensor"):
            continue
        several = get_origin(hint) is tuple and list_choices(hint)
        accepted = f"some of {', '.join(several)}" if several else describe_hint(hint)
        value = _format_default(field)
        if isinstance(settings, kind):
            value = format_value(getattr(settings, field.name))
        meaning = _read_meaning(kind, field.name)
        yield _Entry(prefix + field.name, value, accepted, meaning, kind.__name__)


def _format_entries(entries: list[_Entry]) -> str:
    """Format the help on one field, which several kinds of settings may have."""
    values = " or ".join(dict.fromkeys(entry.value for entry in entries))
    meanings = {entry.kind: entry.meaning for entry in entries}
    if len(set(meanings.values())) > 1:
        meaning = " ".join(
            f"Of {kind}: {text[:1].lower()}{text[1:]}." for kind, text in meanings.items()
        )
    else:
        meaning = entries[0].meaning
    text = f"{entries[0].accepted}. {meaning}".rstrip()
    lines = wrap(text, WIDTH, initial_indent=" " * 4, subsequent_indent=" " * 4)
    return "\n".join([f"--{entries[0].name} {values}", *lines])


def _format_default(field: dataclasses.Field) -> str:
    if field.default is not dataclasses.MISSING:
        return format_value(field.default)
    if field.default_factory is not dataclasses.MISSING:
        return format_value(field.default_factory())
    return ""


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
