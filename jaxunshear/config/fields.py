"""Single settings by dotted name: read from a command line, replaced, shown.

>>> experiment = load_experiment("experiments/demo.py")
>>> experiment = override_fields(experiment, ["--train.epochs", "5", "--sensor", "tactip127"])
>>> validate(experiment)
"""

import difflib
import types
import typing
from collections.abc import Iterable, Mapping, Sequence

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.outlines import parse_stimulus
from jaxunshear.config.sensor import Sensor, get_sensor
from jaxunshear.config.types import (
    WEIGHTS,
    Hint,
    Value,
    describe_hint,
    get_origin,
    list_choices,
    list_groups,
    list_hints,
    replace_value,
)
from jaxunshear.errors import UserError

# names that other tools have for fields, and ours
USUAL_NAMES = {
    **dict.fromkeys(("lr", "initial_lr", "lr0"), "learning_rate"),
    **dict.fromkeys(("schedule", "lr_schedule", "scheduler", "lr_scheduler"), "drops"),
    **dict.fromkeys(("bs", "batch_size", "minibatch"), "batch"),
    **dict.fromkeys(("num_epochs", "n_epochs", "max_epochs", "iterations"), "epochs"),
    **dict.fromkeys(("weight_decay", "wd", "l2_weight"), "l2"),
    **dict.fromkeys(("optimizer", "optim", "opt"), "optimiser"),
    "ema": "ema_decay",
    **dict.fromkeys(("loss", "loss_weights"), "losses"),
    **dict.fromkeys(("checkpoint", "pretrained", "weights", "init_from", "resume"), "start"),
    **dict.fromkeys(("image_size", "img_size", "imgsz", "resolution"), "size"),
    **dict.fromkeys(("latent_dim", "z_dim", "code_size"), "pose_channels"),
    **dict.fromkeys(("random_seed", "rng_seed"), "seed"),
    **dict.fromkeys(("mu", "friction_coefficient"), "friction"),
}
# they name settings, folders or what is in a layout file, and set none
NOT_SETTABLE = ("config", "digest", "tasks", "names", "markers", "dark")


def override_fields(experiment: Experiment, argv: Sequence[str]) -> Experiment:
    """Replace the fields that `--name value` or `--name=value` name; the last of two wins."""
    for name, value in parse_overrides(argv):
        experiment = replace_field(experiment, name, value)
    return experiment


def replace_field(experiment: Experiment, name: str, value: object) -> Experiment:
    """Replace the field of this dotted name, by a value of any type. Raises UserError."""
    _find_field_type(name)
    return replace_value(experiment, name, value)


def _find_field_type(name: str) -> Hint:
    """Return the type of a field, or of one weight of a field of weights. Raises UserError."""
    kinds = list_field_types()
    group, _, part = name.rpartition(".")
    if part and kinds.get(group) == WEIGHTS:
        return float
    if name not in kinds:
        raise UserError(f"there is no field --{name}{_suggest_field(name, list(kinds))}")
    return kinds[name]


def parse_overrides(argv: Sequence[str]) -> list[tuple[str, Value]]:
    """Parse `--name value` or `--name=value` to dotted names and values. Raises UserError."""
    pairs = []
    words = iter(argv)
    for word in words:
        if not word.startswith("--"):
            raise UserError(
                f"argument '{word}' is not understood: fields are changed by --name value"
            )
        name, equals, text = word[2:].partition("=")
        kind = _find_field_type(name)
        if not equals:
            text = next(words, "--")
            if text.startswith("--"):
                raise UserError(f"--{name} needs a value: {describe_hint(kind)}")
        try:
            pairs.append((name, _parse_value(text.strip(), kind)))
        except ValueError:
            raise UserError(f"--{name} takes {describe_hint(kind)}, not '{text}'") from None
    return pairs


def split_overrides(
    argv: Sequence[str], options: Iterable[str], flags: Iterable[str]
) -> tuple[list[str], list[str]]:
    """Split a command line into words for argparse and fields; no value follows `flags`."""
    arguments: list[str] = []
    fields: list[str] = []
    words = iter(argv)
    for word in words:
        is_field = word.startswith("--") and word.partition("=")[0] not in options
        part = fields if is_field else arguments
        part.append(word)
        if word.startswith("--") and "=" not in word and word not in flags:
            value = next(words, None)
            part.extend([] if value is None else [value])
    return arguments, fields


def list_field_types(kind: type = Experiment, prefix: str = "") -> dict[str, Hint]:
    """List the types of all fields that can be set, of each kind of a group, by dotted name."""
    fields = {}
    for name, hint in list_hints(kind).items():
        groups = list_groups(hint)
        if name in NOT_SETTABLE:
            continue
        if not groups or hint is Sensor:
            fields[prefix + name] = hint
        for group in groups:
            fields |= list_field_types(group, f"{prefix}{name}.")
    return fields


def format_value(value: object) -> str:
    """Write a field's value as on the command line; a sensor by its name."""
    if isinstance(value, Sensor):
        return value.name
    if isinstance(value, Mapping):
        value = tuple(value.items())
    if isinstance(value, tuple):
        parts = [item if isinstance(item, tuple) else (item,) for item in value]
        return ",".join(":".join(map(str, part)) for part in parts) or "''"
    return str(value).lower() if isinstance(value, bool) else str(value)


def _suggest_field(name: str, kinds: list[str]) -> str:
    if name in ("paired.config", "pose.config"):
        return (
            ": a configuration is chosen by the experiment's file; "
            "run another one, or change its fields"
        )
    if name == "without":
        return (
            ": a training leaves out the pins that no frame shows; "
            "`doctor`, `pins`, `pose`, `unshear` and `stream` take the numbers of lost pins"
        )
    inside = [f"--{kind}" for kind in kinds if kind.startswith(name + ".")]
    if inside:
        more = ", ..." if len(inside) > 4 else ""
        return f": it is a group, with {', '.join(inside[:4])}{more}"
    group, _, own = name.rpartition(".")
    ours = USUAL_NAMES.get(own.lower().replace("-", "_"), own)
    last = [kind for kind in kinds if kind.rpartition(".")[2] == ours]
    last = [kind for kind in last if kind == f"{group}.{ours}"] or last
    near = last[:3] or difflib.get_close_matches(name, kinds, n=1)
    if not near:
        return ": see `jaxunshear run --help`"
    return f": did you mean {' or '.join('--' + kind for kind in near)}?"


def _parse_value(text: str, kind: Hint) -> Value:
    """Parse `text` as a value of `kind`. Raises ValueError."""
    kinds = typing.get_args(kind)
    if types.NoneType in kinds:
        return None if text.lower() == "none" else _parse_value(text, kinds[0])
    if get_origin(kind) is tuple:
        is_list = kinds[-1] is ...
        items = text.split("," if is_list else ":") if text or not is_list else []
        if not all(map(str.strip, items)):
            raise ValueError
        kinds = kinds[:1] * len(items) if is_list else kinds
        pairs = zip(items, kinds, strict=True)
        return tuple(_parse_value(item.strip(), each) for item, each in pairs)
    if kind == WEIGHTS:
        weights = [item.split(":") for item in text.split(",") if item]
        return {name.strip(): float(weight) for name, weight in weights}
    if kind is bool:
        if text.lower() not in ("true", "false"):
            raise ValueError
        return text.lower() == "true"
    if kind is Sensor:
        return get_sensor(text)
    if list_choices(kind):
        return parse_stimulus(text) if list_groups(kind) else text
    return kind(text)
