"""How the files of docs/results were made: by which command, with which code and settings."""

import dataclasses
import json
import shlex
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from docs.code_changes import (
    EARLIER_MODULES,
    find_programs,
    list_lost_definitions,
    translate_command,
)
from jaxunshear.cli import read_base
from jaxunshear.config.serialization import to_json
from jaxunshear.files import Json, to_builtins
from jaxunshear.results.measurement import Source

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
# settings that decide no figure; those with drops had a schedule in steps
NAMES = ("name", "claim", "digest", "tap_folder", "slide_folder", "schedule")
# that results may lack: all of these had more steps, and more pairs
LATER = ("min_steps", "rotated_below")
IDLE = {  # settings of results that are gone, at the values at which they did nothing
    "shear_noise": 0.0,
    "residual": 0,
    "both_sides": False,
    "mirror": False,
    "hidden_pins": 0.0,
    "label_weight": 0.0,
    "precision": "float32",
    "beta2": 0.999,
}
LOSSES_0_2 = {  # weights of losses in the settings of version 0.2.0, and the losses
    "patch_weight": "patch",
    "reconstruction_weight": "reconstruction",
    "swap_weight": "counterfactual",
    "agreement_weight": "code_agreement",
    "slide_weight": "slide",
    "tap_weight": "tap",
    "alike_weight": "consistency",
    "pose_weight": "pose",
}
NOTE = "<sub>From "


class Stale(NamedTuple):
    """What docs/stale.toml says of results, by name without `.json`."""

    not_kept: Mapping[str, str]  # made before results kept their commit: the first that has them
    changed: Mapping[str, str]  # why a result stays although its code has changed
    settings: Mapping[str, str]  # why its command gives other settings today
    bridges: Sequence[tuple[str, str]]  # commits without a change of figures, the earliest first


def read_stale(path: Path = ROOT / "docs" / "stale.toml") -> Stale:
    """Read which results are older than their code."""
    content = tomllib.loads(path.read_text())
    reasons: dict[str, dict[str, str]] = {"changed": {}, "settings": {}}
    for kind, by_name in reasons.items():
        for entry in content.get(kind, []):
            by_name |= dict.fromkeys(entry["files"], entry["why"])
    bridges = [(entry["before"], entry["after"]) for entry in content.get("bridges", [])]
    return Stale(content["not_kept"], reasons["changed"], reasons["settings"], bridges)


@cache
def read_result(name: str) -> Json:
    """Read docs/results/<name>.json."""
    return json.loads((RESULTS / f"{name}.json").read_text())


def list_parts(result: Json) -> list[Json]:
    """Return the results that a file consists of: itself, or those of several runs."""
    return list(result["runs"].values()) if "runs" in result else [result]


def list_sources(result: Json) -> list[Source]:
    """Return the code that trained or evaluated; empty if one part of the file does not say."""
    sources: list[Source] = []
    for part in list_parts(result):
        trained_by = part.get("trained_by", {})
        stored = [*part.get("sources", []), *trained_by.values()]
        stored += [part["source"]] if part.get("source") else []
        # a sweep has a list, whose `sources` are complete or none
        trained_on = part.get("trained_on", {})
        incomplete = isinstance(trained_on, dict) and trained_on.keys() - trained_by.keys()
        if not stored or incomplete:
            return []
        sources += [Source(**each) for each in stored]
    return list(dict.fromkeys(sources))


def list_commands(result: Json) -> list[str]:
    """Return what was typed, each command once."""
    commands = [part["command"] for part in list_parts(result) if part.get("command")]
    return list(dict.fromkeys(commands))


def format_note(names: Iterable[str], page: str) -> str:
    """Return the line under a table: the files that it is made from, their commands and code."""
    folder = "docs/results" if page == "README.md" else "results"
    stale = read_stale()
    sentences = []
    for name in names:
        origin = describe_origin(read_result(name))
        words = [origin] if origin else []
        if name in stale.not_kept:
            words.append(f"figures committed in {stale.not_kept[name]}")
        if name in stale.changed:
            words.append("its code has changed since")
        if name in stale.settings:
            words.append("to repeat it take the settings in the file (today's defaults differ)")
        sentences.append(f"[{name}.json]({folder}/{name}.json): {', '.join(words)}")
    return f"{NOTE}{'; '.join(sentences)}.</sub>"


def describe_origin(result: Json) -> str:
    """Say how a result was made."""
    commands, sources = list_commands(result), list_sources(result)
    words = [f"`{commands[0]}`{_describe_move(commands[0])}"] if commands else []
    if len(commands) > 1:
        more = len(commands) - 1
        words.append(f"and {more} more command{'s' if more > 1 else ''}")
    words += map(_describe_source, sources)
    if not sources and (version := _describe_version(result)):
        words.append(version)
    return ", ".join(words)


def _describe_source(source: Source) -> str:
    if source.commit is None:
        return f"version {source.version} of {source.date}"
    unclean = "" if source.clean else " with uncommitted changes"
    return f"commit {source.commit[:7]} of {source.date}{unclean}"


def _describe_version(result: Json) -> str:
    versions: set[str] = set()
    for part in list_parts(result):
        stored = part.get("versions") or []
        for each in stored if isinstance(stored, list) else [stored]:
            versions |= {each["jaxunshear"]} if "jaxunshear" in each else set()
    return f"version {' and '.join(sorted(versions))}" if versions else ""


def _describe_move(command: str) -> str:
    """Say where a command or its experiment file is today, if it has moved."""
    if (today := translate_command(command)) != command:
        return f" (now `{today.partition(' --')[0]}`)"
    for word in shlex.split(command):
        if word.endswith(".py") and not (ROOT / word).exists():
            path = Path(_find_file(word))
            if path.is_absolute():
                return f" (now {path.relative_to(ROOT)})"
            return " (a file that is gone)"
    return ""


def find_changed_settings(name: str) -> dict[str, tuple[object, object]]:
    """Return the settings of a run or sweep that its command gives otherwise today: then, now.

    Names and places are left out. A setting that came later has its default then; one that went
    has, today, the value at which it did nothing.
    """
    result = read_result(name)
    stored = result.get("base") or result.get("settings")
    if not stored:
        return {}
    experiment = read_base([_find_file(word) for word in shlex.split(result["command"])[1:]])
    now = _flatten(to_builtins(to_json(experiment)))
    kept = _flatten(_name_losses(stored))
    then = _flatten(to_builtins(_read_defaults(experiment))) | kept
    for field in now.keys() ^ then.keys():
        if ".losses." in field:  # a loss of weight 0 is not there
            (then if field in now else now)[field] = 0.0
    gone = {field: IDLE.get(_get_last_part(field)) for field in then.keys() - now.keys()}
    return {
        field: (then[field], value)
        for field, value in {**now, **gone}.items()
        if then[field] != value
        and _get_last_part(field) not in NAMES
        and (field in kept or _get_last_part(field) not in LATER)
    }


def _name_losses(stored: Json) -> Json:
    """Return settings with the weights of losses by name, which version 0.2.0 had as settings."""
    named = {}
    for group, settings in stored.items():
        if not (isinstance(settings, dict) and "patch_weight" in settings):
            named[group] = settings
            continue
        rest = {field: value for field, value in settings.items() if field not in LOSSES_0_2}
        target = rest.pop("pose_target", "tap")
        if group in ("train_posenet", "train_teacher"):
            weights = {"pose": 1.0}
        else:
            given = {LOSSES_0_2[field]: settings[field] for field in LOSSES_0_2.keys() & settings}
            given[f"pose_{target}"] = given.pop("pose", 0.0)
            weights = {"supervised": 1.0, **given}
        named[group] = rest | {"losses": weights}
    return named


def _read_defaults(group: Any) -> Json:
    """Return the defaults of the fields of a dataclass and of the groups in it."""
    defaults = {}
    for field in dataclasses.fields(group):
        value = getattr(group, field.name)
        default = None if field.default is dataclasses.MISSING else field.default
        if field.name == "losses":
            default = {}
        defaults[field.name] = _read_defaults(value) if dataclasses.is_dataclass(value) else default
    return defaults


def _get_last_part(field: str) -> str:
    return field.rpartition(".")[2]


def _find_file(word: str) -> str:
    """Return where a file named in a command is today."""
    paths = sorted(ROOT.glob(f"experiments/**/{Path(word).name}")) if word.endswith(".py") else []
    return str(paths[0]) if paths else word


def _flatten(settings: Json, group: str = "") -> Json:
    flat: Json = {}
    for name, value in settings.items():
        dotted = f"{group}{name}"
        flat |= _flatten(value, f"{dotted}.") if isinstance(value, dict) else {dotted: value}
    return flat


def find_changed_code(name: str, root: Path = ROOT) -> list[str]:
    """Return what a result was computed with and the package no longer has."""
    result = read_result(name)
    starts = sorted(
        {module for command in list_commands(result) for module in find_programs(command)}
    )
    starts += [name for module in starts for name in EARLIER_MODULES.get(module, ())]
    changes: set[str] = set()
    for source in list_sources(result):
        try:
            bridges = read_stale().bridges
            changes |= set(list_lost_definitions(root, source.commit or "", starts, bridges))
        except LookupError:
            changes.add(f"commit {source.commit} is not in this history")
    return sorted(changes)
