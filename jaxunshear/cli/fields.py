"""`--help-fields GROUP`: the fields of a group of settings, each with its value, what it takes and
what it means.
"""

import dataclasses
from collections.abc import Iterator
from textwrap import wrap
from typing import NamedTuple

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import NOT_SETTABLE, format_value
from jaxunshear.config.types import (
    describe_hint,
    get_origin,
    list_choices,
    list_groups,
    list_hints,
)
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
    known = dict(_groups(Experiment, ""))
    if group not in known:
        raise UserError(
            f"{FLAG} {group}: name one of {', '.join(filter(None, known))}, or '' for those of no group"
        )
    held = _group(experiment or Experiment(name="", claim=""), group)
    entries: dict[str, list[_Entry]] = {}
    for kind in [type(held)] if experiment else known[group]:
        for entry in _entries(kind, held, f"{group}." if group else ""):
            entries.setdefault(entry.name, []).append(entry)
    return "\n".join(map(_text, entries.values()))


def _group(experiment: Experiment, name: str) -> object:
    held: object = experiment
    for part in filter(None, name.split(".")):
        if not hasattr(held, part):
            raise UserError(
                f"{FLAG} {name}: this experiment has no {part} there: its {type(held).__name__} has other fields"
            )
        held = getattr(held, part)
    return held


def _groups(kind: type, name: str) -> Iterator[tuple[str, list[type]]]:
    """Groups by dotted name, with the kinds of settings that each may hold."""
    yield name, [kind]
    for field, hint in list_hints(kind).items():
        below = f"{name}.{field}".lstrip(".")
        found: dict[str, list[type]] = {}
        for each in list_groups(hint):
            for inner, kinds in _groups(each, below):
                found.setdefault(inner, []).extend(kinds)
        yield from found.items()


class _Entry(NamedTuple):
    name: str
    value: str
    accepted: str
    meaning: str
    kind: str  # of settings that have this field


def _entries(kind: type, held: object, prefix: str) -> Iterator[_Entry]:
    """Yield the fields of a kind of settings, with the values of `held` if it is of that kind."""
    for field in dataclasses.fields(kind):
        hint = list_hints(kind)[field.name]
        if field.name in NOT_SETTABLE or (list_groups(hint) and prefix + field.name != "sensor"):
            continue
        several = get_origin(hint) is tuple and list_choices(hint)
        takes = f"some of {', '.join(several)}" if several else describe_hint(hint)
        value = (
            format_value(getattr(held, field.name)) if isinstance(held, kind) else _default(field)
        )
        yield _Entry(prefix + field.name, value, takes, _meaning(kind, field.name), kind.__name__)


def _text(entries: list[_Entry]) -> str:
    """Say it of one field, which several kinds of settings may have."""
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


def _default(field: dataclasses.Field) -> str:
    if field.default is not dataclasses.MISSING:
        return format_value(field.default)
    return (
        ""
        if field.default_factory is dataclasses.MISSING
        else format_value(field.default_factory())
    )


def _meaning(kind: type, field: str) -> str:
    """The comment beside or above the field's definition."""
    from simple_parsing.docstring import (
        get_attribute_docstring,  # only for this: the command line starts quickly
    )

    owner = next(
        base for base in reversed(kind.__mro__) if field in vars(base).get("__annotations__", {})
    )
    written = get_attribute_docstring(owner, field)
    text = " ".join((written.comment_inline or written.comment_above).split())
    return text[:1].upper() + text[1:]
