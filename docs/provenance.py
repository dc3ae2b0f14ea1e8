"""How the files of docs/results were made: by which command, with which code, and whether that code
has changed since.

A result depends on what its command imports of COMPUTING. Of that code a definition (a function,
class or constant at the top of a module) has changed if no module of ours has it today.
Comments, docstrings and layout do not count, nor does a definition that moved or was added: what
did not exist cannot have made a result. Settings do not count either, since a result keeps its own.
Commits between which no figure changed, although definitions did, are listed in stale.toml as a
`bridge`: what a result was made with is compared up to its one end, and on from its other end.
"""

import ast
import dataclasses
import hashlib
import json
import shlex
import subprocess
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from jaxunshear.cli import read_base
from jaxunshear.config.serialization import to_json
from jaxunshear.files import Json
from jaxunshear.results.measurement import Source
from jaxunshear.serialization import to_builtins

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
PACKAGES = PACKAGE, *TOOLS = ("jaxunshear", "verification", "benchmarks")
NAMES = ("name", "claim", "digest", "tap_folder", "slide_folder")  # settings that decide no figure
IDLE = {  # settings of results that are gone, at the values at which they did nothing
    "shear_noise": 0.0,
    "residual": 0,
    "both_sides": False,
    "mirror": False,
    "hidden_pins": 0.0,
    "label_weight": 0.0,
    "precision": "float32",
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
COMPUTING = frozenset(
    (
        *("simulator", "perception", "data", "models", "training", "evaluation", "metrics"),
        *("sweep", "calibration", "verification", "benchmarks"),
        *("doctor", "inference", "downstream", "apps"),
        # the names of these packages at the commits of earlier results
        *("scene", "contact", "image", "dataset", "model", "applications"),
    )
)
PROGRAMS = {  # the modules that a command starts from
    "run": ("run",),
    "fit": ("run",),
    "sweep": ("sweep.run", "sweep.worker"),
    "evaluate": ("run", "evaluation.other_recordings", "evaluation.sim_to_real"),
    "ablate": ("evaluation.code_swap_test", "evaluation.leakage"),
    "validate": ("calibration.validate",),
    "calibrate": ("calibration.calibrate",),
    **{name: (f"cli.{name}",) for name in ("geometry", "servo", "reconstruct", "pins", "stream")},
    "unshear": ("inference.infer",),
    "pose": ("inference.infer",),
}
TOOL_PROGRAMS = {  # the same, of `python -m`
    "verification verify": ("verification.verify",),
    "verification stability": ("verification.stability",),
    "verification plan": ("verification.plan_report",),
    **{
        f"benchmarks {name}": ("benchmarks.bench_networks",)
        for name in ("train", "infer", "stream")
    },
    **{f"benchmarks {name}": (f"benchmarks.bench_{name}",) for name in ("sim", "pins", "data")},
    "benchmarks needs": ("benchmarks.bench_omissions",),
    "benchmarks input": ("benchmarks.bench_input_pipeline",),
    "benchmarks pinnets": ("benchmarks.bench_pin_networks",),
    "benchmarks explore": ("benchmarks.bench_explore",),
}
EARLIER = {  # where these modules were at earlier commits
    "jaxunshear.evaluation.sim_to_real": (
        "jaxunshear.evaluation.transfer",
        "jaxunshear.applications.transfer",
    ),
    "jaxunshear.evaluation.other_recordings": ("jaxunshear.evaluation.unseen",),
    "jaxunshear.evaluation.code_swap_test": ("jaxunshear.evaluation.ablation",),
    "jaxunshear.sweep.worker": ("jaxunshear.sweep.work",),
    "jaxunshear.inference.infer": ("jaxunshear.infer",),
    "benchmarks.bench_omissions": ("benchmarks.bench_needs",),
    "benchmarks.bench_input_pipeline": ("benchmarks.bench_input",),
}
MOVED = {  # how commands of earlier versions begin, and where each is today; the first that fits
    "jaxunshear check identify": "docs/notebooks/identify.ipynb",
    "jaxunshear check bench": "python -m benchmarks",
    "jaxunshear check": "python -m verification",
}


class Known(NamedTuple):
    """What docs/stale.toml says of results, by name without `.json`."""

    not_kept: frozenset[str]  # made before results kept their commit
    changed: Mapping[str, str]  # why a result stays although its code has changed
    settings: Mapping[str, str]  # why its command gives other settings today
    bridges: Sequence[
        tuple[str, str]
    ]  # commits between which no figure changed, the earliest first


def read_known(path: Path = ROOT / "docs" / "stale.toml") -> Known:
    """Read which results are known to be older than their code."""
    held = tomllib.loads(path.read_text())
    changed, settings = (
        {name: each["why"] for each in held.get(kind, []) for name in each["files"]}
        for kind in ("changed", "settings")
    )
    bridges = [(each["before"], each["after"]) for each in held.get("bridges", [])]
    return Known(frozenset(held["not_kept"]), changed, settings, bridges)


@cache
def read_result(name: str) -> Json:
    """Read docs/results/<name>.json."""
    return json.loads((RESULTS / f"{name}.json").read_text())


def parts(held: Json) -> list[Json]:
    """Return the results that a file consists of: itself, or those of several runs."""
    return list(held["runs"].values()) if "runs" in held else [held]


def sources(held: Json) -> list[Source]:
    """Return the code that trained or evaluated; empty if one part of the file does not say."""
    found = []
    for part in parts(held):
        own = [*part.get("sources", []), *part.get("trained_by", {}).values()]
        own += [part["source"]] if part.get("source") else []
        trained = part.get(
            "trained_on", {}
        )  # of a sweep a list, whose `sources` are complete or none
        if not own or (
            isinstance(trained, dict) and trained.keys() - part.get("trained_by", {}).keys()
        ):
            return []
        found += own
    return list(dict.fromkeys(Source(**each) for each in found))


def commands(held: Json) -> list[str]:
    """Return what was typed, each command once."""
    return list(dict.fromkeys(part["command"] for part in parts(held) if part.get("command")))


def note(names: Iterable[str], page: str) -> str:
    """Return the line under a table: the files that it is made from, their commands and code."""
    folder = "docs/results" if page == "README.md" else "results"
    known = read_known()
    said = [
        ", ".join(
            [f"[{name}.json]({folder}/{name}.json): {origin(read_result(name))}"]
            + ["its code has changed since"] * (name in known.changed)
            + ["its command gives other settings today"] * (name in known.settings)
        )
        for name in names
    ]
    return f"{NOTE}{'; '.join(said)}.</sub>"


NOTE = "<sub>From "


def origin(held: Json) -> str:
    """Say how a result was made."""
    typed, made = commands(held), sources(held)
    words = [f"`{typed[0]}`{_moved(typed[0])}"] if typed else []
    words += [f"and {len(typed) - 1} more commands"] * (len(typed) > 1)
    words += [_code(one) for one in made] if made else [f"{_version(held)}commit not kept"]
    return ", ".join(words)


def _code(source: Source) -> str:
    if source.commit is None:
        return f"version {source.version} of {source.date}"
    unclean = "" if source.clean else " with uncommitted changes"
    return f"commit {source.commit[:7]} of {source.date}{unclean}"


def _version(held: Json) -> str:
    listed = [part.get("versions") or [] for part in parts(held)]
    each = [one for many in listed for one in (many if isinstance(many, list) else [many])]
    found = sorted({one["jaxunshear"] for one in each if "jaxunshear" in one})
    return f"version {' and '.join(found)}, " if found else ""


def _moved(command: str) -> str:
    """Say where a command or its experiment file is today, if it has moved."""
    if (today := command_today(command)) != command:
        return f" (now `{today.partition(' --')[0]}`)"
    for word in shlex.split(command):
        if word.endswith(".py") and not (ROOT / word).exists():
            today = Path(_today(word))
            return (
                f" (now {today.relative_to(ROOT)})"
                if today.is_absolute()
                else " (a file that is gone)"
            )
    return ""


def command_today(command: str) -> str:
    """Return a command of an earlier version as it is written today."""
    for before, today in MOVED.items():
        if command.startswith(f"{before} "):
            return today + command.removeprefix(before)
    return command


def differences(name: str) -> dict[str, tuple[object, object]]:
    """Return the settings of a run or sweep that its command gives otherwise today: then, now.

    Names and places are left out. A setting that came later has its default then; one that went has,
    today, the value at which it did nothing.
    """
    held = read_result(name)
    stored = held.get("base") or held.get("settings")
    if not stored:
        return {}
    words = [_today(word) for word in shlex.split(held["command"])[1:]]
    experiment = read_base(words)
    now = _flat(to_builtins(to_json(experiment)))
    then = _flat(to_builtins(_defaults(experiment))) | _flat(_name_losses(stored))
    for field in now.keys() ^ then.keys():
        if ".losses." in field:  # a loss of weight 0 is not there
            (then if field in now else now)[field] = 0.0
    gone = {field: IDLE.get(_last(field)) for field in then.keys() - now.keys()}
    return {
        field: (then[field], value)
        for field, value in {**now, **gone}.items()
        if then[field] != value and _last(field) not in NAMES
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


def _defaults(group: Any) -> Json:
    """Return the defaults of the fields of a dataclass and of the groups in it."""
    found = {}
    for field in dataclasses.fields(group):
        value = getattr(group, field.name)
        default = None if field.default is dataclasses.MISSING else field.default
        if field.name == "losses":
            default = {}
        found[field.name] = _defaults(value) if dataclasses.is_dataclass(value) else default
    return found


def _last(field: str) -> str:
    return field.rpartition(".")[2]


def _today(word: str) -> str:
    """Return where a file named in a command is today."""
    found = sorted(ROOT.glob(f"experiments/**/{Path(word).name}")) if word.endswith(".py") else []
    return str(found[0]) if found else word


def _flat(settings: Json, group: str = "") -> Json:
    found: Json = {}
    for name, value in settings.items():
        found |= (
            _flat(value, f"{group}{name}.")
            if isinstance(value, dict)
            else {f"{group}{name}": value}
        )
    return found


def changes(name: str, root: Path = ROOT) -> list[str]:
    """Return what a result was computed with and the package no longer has, as `lost`."""
    held = read_result(name)
    starts = sorted({module for command in commands(held) for module in programs(command)})
    starts += [name for module in starts for name in EARLIER.get(module, ())]
    found: set[str] = set()
    for source in sources(held):
        try:
            found |= set(_changes_since(root, source.commit or "", starts))
        except LookupError:
            found.add(f"commit {source.commit} is not in this history")
    return sorted(found)


def _changes_since(root: Path, commit: str, starts: Sequence[str]) -> list[str]:
    """Compare the code of a commit with today's, without what changed on bridges. Raises LookupError."""
    found: list[str] = []
    for before, after in read_known().bridges:
        if is_ancestor(root, commit, before):
            found += lost(read_modules(root, commit), read_modules(root, before), starts)
            commit = after
    return found + lost(read_modules(root, commit), read_modules(root), starts)


def is_ancestor(root: Path, earlier: str, later: str) -> bool:
    """Return whether a commit is another, or among those that led to it. Raises LookupError."""
    return (
        git(root, "merge-base", earlier, later).strip() == git(root, "rev-parse", earlier).strip()
    )


def lost(then: Mapping[str, str], later: Mapping[str, str], starts: Sequence[str]) -> list[str]:
    """Return a line for each definition that `starts` import among `then` and that `later` lacks.

    A line is the module and the name. Only definitions of COMPUTING count.
    """
    used = [
        module
        for module in imports(then, starts)
        if not COMPUTING.isdisjoint(module.split(".")[:2])
    ]
    alive = {key for text in later.values() for key in definitions(text).values()}
    return [
        f"{module}: {name}"
        for module in sorted(used)
        for name, key in definitions(then[module]).items()
        if key not in alive
    ]


def programs(command: str) -> list[str]:
    """Return the modules that a command of ours starts from. Raises LookupError."""
    words = command_today(command).split()
    if words[0] == PACKAGE:
        found = [f"{PACKAGE}.{module}" for module in PROGRAMS.get(words[1], ())]
    elif words[:2] == ["python", "-m"] and words[2] in TOOLS:
        found = [*TOOL_PROGRAMS.get(" ".join(words[2:4]), ())]
    else:
        return []
    if not found:
        raise LookupError(f"PROGRAMS and TOOL_PROGRAMS lack the modules of `{command}`")
    return found


@cache
def read_modules(root: Path, commit: str | None = None) -> Mapping[str, str]:
    """Return our modules as text, of today or of a commit. Raises LookupError."""
    if commit is None:
        paths = [path for folder in PACKAGES for path in (root / folder).rglob("*.py")]
        return {_module(path.relative_to(root).as_posix()): path.read_text() for path in paths}
    listed = git(root, "ls-tree", "-r", commit, "--", *PACKAGES).decode().splitlines()
    blobs = {line.partition("\t")[2]: line.split()[2] for line in listed if line.endswith(".py")}
    held = git(root, "cat-file", "--batch", given="\n".join(blobs.values()).encode())
    found = {}
    for name in blobs:  # a head line with the size, the text, a line break
        head, _, held = held.partition(b"\n")
        size = int(head.split()[-1])
        found[_module(name)], held = held[:size].decode(), held[size + 1 :]
    return found


def git(root: Path, *words: str, given: bytes = b"") -> bytes:
    """Return what git answers. Raises LookupError if there is no git, or nothing of that name."""
    try:
        done = subprocess.run(["git", *words], cwd=root, input=given, capture_output=True)
    except OSError as error:
        raise LookupError(str(error)) from error
    if done.returncode:
        raise LookupError(done.stderr.decode().strip())
    return done.stdout


def _module(path: str) -> str:
    return path.removesuffix(".py").replace("/", ".").removesuffix(".__init__")


def imports(modules: Mapping[str, str], starts: Iterable[str]) -> set[str]:
    """Return the modules that `starts` import, at their top or later, and all theirs."""
    seen: set[str] = set()
    left = [module for module in starts if module in modules]
    while left:
        module = left.pop()
        if module not in seen:
            seen.add(module)
            left += _imported(modules[module]) & modules.keys()
    return seen


@cache
def _imported(text: str) -> frozenset[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {each.name for each in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{each.name}" for each in node.names)}
    return frozenset(found)


@cache
def definitions(text: str) -> Mapping[str, str]:
    """Return a key of each definition at the top of a module, by name.

    Keys do not depend on the version of Python.
    """
    found: dict[str, str] = {}
    for node in _body(ast.parse(text)):
        if not isinstance(node, ast.Import | ast.ImportFrom):
            name = _name(node)
            found[name] = found.get(name, "") + _syntax(node)
    return {
        name: hashlib.sha256(syntax.encode()).hexdigest()[:12] for name, syntax in found.items()
    }


def _syntax(node: object) -> str:
    """Return syntax as text, without docstrings and without what is empty.

    Some versions of Python leave out what is empty.
    """
    if isinstance(node, list):
        return f"[{', '.join(map(_syntax, node))}]"
    if not isinstance(node, ast.AST):
        return repr(node)
    fields = dict(ast.iter_fields(node))
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        fields["body"] = _body(node)
    held = ", ".join(
        f"{name}={_syntax(value)}" for name, value in fields.items() if value not in (None, [])
    )
    return f"{type(node).__name__}({held})"


def _body(
    node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module,
) -> list[ast.stmt]:
    return node.body if ast.get_docstring(node, clean=False) is None else node.body[1:]


def _name(node: ast.stmt) -> str:
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return node.name
    targets = (
        node.targets
        if isinstance(node, ast.Assign)
        else [node.target]
        if isinstance(node, ast.AnnAssign)
        else []
    )
    return ", ".join(map(ast.unparse, targets)) or "its own lines"
