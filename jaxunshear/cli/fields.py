"""`--help-fields GROUP`: the fields of a group of settings, each with its default, what it takes and what it means."""

import dataclasses
from collections.abc import Iterator
from textwrap import wrap

from jaxunshear.errors import UserError
from jaxunshear.settings.experiment import Experiment
from jaxunshear.settings.fields import NOT_SET, show
from jaxunshear.settings.types import choices, describe, groups, hints, origin

FLAG = "--help-fields"
WIDTH = 100


def asked_for(argv: list[str]) -> str | None:
    """The group that a command line asks about; None where it does not."""
    for place, word in enumerate(argv):
        name, _, value = word.partition("=")
        if name == FLAG:
            return value or next(iter(argv[place + 1 : place + 2]), "")
    return None


def help_on(group: str) -> str:
    """Raises UserError for a group that there is not."""
    known = dict(_groups(Experiment, ""))
    if group not in known:
        raise UserError(f"{FLAG} {group}: name one of {', '.join(filter(None, known))}, or '' for those of no group")
    lines = [text for kind in known[group] for text in _of_kind(kind, f"{group}." if group else "")]
    return "\n".join(dict.fromkeys(lines))


def _groups(kind: type, name: str) -> Iterator[tuple[str, list[type]]]:
    """Groups by dotted name, with the kinds of settings that each may hold."""
    yield name, [kind]
    for field, hint in hints(kind).items():
        below = f"{name}.{field}".lstrip(".")
        found: dict[str, list[type]] = {}
        for each in groups(hint):
            for inner, kinds in _groups(each, below):
                found.setdefault(inner, []).extend(kinds)
        yield from found.items()


def _of_kind(kind: type, prefix: str) -> Iterator[str]:
    for field in dataclasses.fields(kind):
        hint = hints(kind)[field.name]
        if field.name in NOT_SET or (groups(hint) and prefix + field.name != "sensor"):
            continue
        several = origin(hint) is tuple and choices(hint)
        takes = f"some of {', '.join(several)}" if several else describe(hint)
        yield f"--{prefix}{field.name} {_default(field)}\n" + "\n".join(
            wrap(
                f"{takes}. {_meaning(kind, field.name)}".rstrip(),
                WIDTH,
                initial_indent="    ",
                subsequent_indent="    ",
            )
        )


def _default(field: dataclasses.Field) -> str:
    if field.default is not dataclasses.MISSING:
        return show(field.default)
    return "" if field.default_factory is dataclasses.MISSING else show(field.default_factory())


def _meaning(kind: type, field: str) -> str:
    """The comment beside or above the field's definition."""
    from simple_parsing.docstring import get_attribute_docstring  # only for this: the command line starts quickly

    owner = next(base for base in reversed(kind.__mro__) if field in vars(base).get("__annotations__", {}))
    written = get_attribute_docstring(owner, field)
    text = " ".join((written.comment_inline or written.comment_above).split())
    return text[:1].upper() + text[1:]
