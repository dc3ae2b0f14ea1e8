"""Whether the code that made a result has changed since.

A result depends on what its command imports of COMPUTING. Of that code a definition (a function,
class or constant at the top of a module) has changed if no module of ours has it today.
Comments, docstrings and layout do not count, nor does a definition that moved or was added: what
did not exist cannot have made a result. Settings do not count either, since a result keeps its own.
Commits between which no figure changed, although definitions did, are listed in stale.toml as a
`bridge`: what a result was made with is compared up to its one end, and on from its other end.
"""

import ast
import hashlib
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path

PACKAGES = PACKAGE, *TOOLS = ("jaxunshear", "verification", "benchmarks")
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
    "fit": ("run", "task_run", "data.task_source"),
    "sweep": ("sweep.run", "sweep.worker"),
    "evaluate": ("run", "evaluation.recorded_evaluation", "evaluation.sim_to_real"),
    "ablate": ("evaluation.code_swaps", "evaluation.leakage"),
    "validate": ("calibration.validate",),
    "calibrate": ("calibration.calibrate",),
    **dict.fromkeys(("geometry", "servo", "reconstruct", "pins"), ("cli.models",)),
    "stream": ("cli.apps",),
    "unshear": ("inference.infer",),
    "pose": ("inference.infer",),
}
TOOL_PROGRAMS = {  # the modules that `python -m` starts from
    "verification verify": ("verification.verify",),
    "verification stability": ("verification.stability",),
    **{
        f"benchmarks {name}": ("benchmarks.bench_networks",)
        for name in ("train", "infer", "stream", "frame")
    },
    **{
        f"benchmarks {name}": (f"benchmarks.bench_{name}",)
        for name in (
            *("sim", "pins", "lost_pins", "touch", "filter", "data", "contacts", "adapt"),
            *("taps_alone", "layouts"),
        )
    },
    "benchmarks needs": ("benchmarks.bench_omissions",),
    "benchmarks input": ("benchmarks.bench_input_pipeline",),
    "benchmarks pinnets": ("benchmarks.bench_pin_networks",),
    "benchmarks explore": ("benchmarks.bench_explore",),
}
EARLIER_MODULES = {  # where these modules were at earlier commits
    "jaxunshear.evaluation.sim_to_real": (
        "jaxunshear.evaluation.transfer",
        "jaxunshear.applications.transfer",
    ),
    "jaxunshear.evaluation.recorded_evaluation": (
        "jaxunshear.evaluation.other_recordings",
        "jaxunshear.evaluation.unseen",
    ),
    "jaxunshear.evaluation.code_swaps": (
        "jaxunshear.evaluation.code_swap_test",
        "jaxunshear.evaluation.ablation",
    ),
    "jaxunshear.sweep.worker": ("jaxunshear.sweep.work",),
    "jaxunshear.cli.apps": ("jaxunshear.cli.stream",),
    "jaxunshear.cli.models": tuple(
        f"jaxunshear.cli.{name}" for name in ("geometry", "servo", "reconstruct", "pins")
    ),
    "jaxunshear.inference.infer": ("jaxunshear.infer",),
    "benchmarks.bench_omissions": ("benchmarks.bench_needs",),
    "benchmarks.bench_input_pipeline": ("benchmarks.bench_input",),
}
MOVED_COMMANDS = {  # how earlier commands begin, and what they are today; the first that fits
    "jaxunshear check identify": "docs/notebooks/identify.ipynb",
    "jaxunshear check bench": "python -m benchmarks",
    "jaxunshear check": "python -m verification",
}


def list_lost_definitions(
    root: Path, commit: str, starts: Sequence[str], bridges: Iterable[tuple[str, str]]
) -> list[str]:
    """List what `starts` had at a commit and the code of today lacks, as `compare_modules` does.

    Changes on bridges do not count. Raises LookupError if the history lacks the commit.
    """
    changes: list[str] = []
    for before, after in bridges:
        if is_ancestor(root, commit, before):
            changes += compare_modules(
                read_modules(root, commit), read_modules(root, before), starts
            )
            commit = after
    return changes + compare_modules(read_modules(root, commit), read_modules(root), starts)


def compare_modules(
    then: Mapping[str, str], later: Mapping[str, str], starts: Sequence[str]
) -> list[str]:
    """List the definitions that `starts` import among `then` and that `later` lacks.

    Each is a line of the module and the name. Only definitions of COMPUTING count.
    """
    unchanged = set(then.values()) & set(later.values())
    lost: dict[str, str] = {}
    for module in sorted(find_imported_modules(then, starts)):
        computes = not COMPUTING.isdisjoint(module.split(".")[:2])
        if computes and then[module] not in unchanged:
            definitions = hash_definitions(then[module])
            lost |= {f"{module}: {name}": key for name, key in definitions.items()}
    for texts in (set(later.values()) - unchanged, unchanged):  # the second is seldom needed
        alive = {key for text in texts for key in hash_definitions(text).values()} if lost else ()
        lost = {name: key for name, key in lost.items() if key not in alive}
    return list(lost)


def find_programs(command: str) -> list[str]:
    """Return the modules that a command of ours starts from. Raises LookupError."""
    words = translate_command(command).split()
    if words[0] == PACKAGE:
        programs = [f"{PACKAGE}.{module}" for module in PROGRAMS.get(words[1], ())]
    elif words[:2] == ["python", "-m"] and words[2] in TOOLS:
        programs = [*TOOL_PROGRAMS.get(" ".join(words[2:4]), ())]
    else:
        return []
    if not programs:
        raise LookupError(f"PROGRAMS and TOOL_PROGRAMS lack the modules of `{command}`")
    return programs


def translate_command(command: str) -> str:
    """Return a command of an earlier version as it is written today."""
    for before, today in MOVED_COMMANDS.items():
        if command.startswith(f"{before} "):
            return today + command.removeprefix(before)
    return command


@cache
def read_modules(root: Path, commit: str | None = None) -> Mapping[str, str]:
    """Return our modules as text, of today or of a commit. Raises LookupError."""
    if commit is None:
        paths = [path for folder in PACKAGES for path in (root / folder).rglob("*.py")]
        return {_name_module(path.relative_to(root).as_posix()): path.read_text() for path in paths}
    lines = run_git(root, "ls-tree", "-r", commit, "--", *PACKAGES).decode().splitlines()
    blobs = {line.partition("\t")[2]: line.split()[2] for line in lines if line.endswith(".py")}
    batch = run_git(root, "cat-file", "--batch", stdin="\n".join(blobs.values()).encode())
    modules = {}
    for path in blobs:  # a head line with the size, the text, a line break
        head, _, batch = batch.partition(b"\n")
        size = int(head.split()[-1])
        modules[_name_module(path)], batch = batch[:size].decode(), batch[size + 1 :]
    return modules


def is_ancestor(root: Path, earlier: str, later: str) -> bool:
    """Return whether a commit is another, or among those that led to it. Raises LookupError."""
    merge_base = run_git(root, "merge-base", earlier, later)
    return merge_base.strip() == run_git(root, "rev-parse", earlier).strip()


def run_git(root: Path, *words: str, stdin: bytes = b"") -> bytes:
    """Return what git prints. Raises LookupError if there is no git, or nothing of that name."""
    try:
        done = subprocess.run(["git", *words], cwd=root, input=stdin, capture_output=True)
    except OSError as error:
        raise LookupError(str(error)) from error
    if done.returncode:
        raise LookupError(done.stderr.decode().strip())
    return done.stdout


def _name_module(path: str) -> str:
    return path.removesuffix(".py").replace("/", ".").removesuffix(".__init__")


def find_imported_modules(modules: Mapping[str, str], starts: Iterable[str]) -> set[str]:
    """Return the modules that `starts` import, at their top or later, and all theirs."""
    reached: set[str] = set()
    waiting = [module for module in starts if module in modules]
    while waiting:
        module = waiting.pop()
        if module not in reached:
            reached.add(module)
            waiting += _list_imports(modules[module]) & modules.keys()
    return reached


@cache
def _list_imports(text: str) -> frozenset[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names |= {each.name for each in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{each.name}" for each in node.names)}
    return frozenset(names)


@cache
def hash_definitions(text: str) -> Mapping[str, str]:
    """Return a key of each definition at the top of a module, by name; docstrings do not count."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module):
            node.body = node.body if ast.get_docstring(node, clean=False) is None else node.body[1:]
    definitions: dict[str, str] = {}
    for node in tree.body:
        if not isinstance(node, ast.Import | ast.ImportFrom):
            name = _name_definition(node)
            definitions[name] = definitions.get(name, "") + ast.dump(node)
    return {
        name: hashlib.sha256(syntax.encode()).hexdigest() for name, syntax in definitions.items()
    }


def _name_definition(node: ast.stmt) -> str:
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return node.name
    targets: list[ast.expr] = []
    if isinstance(node, ast.Assign):
        targets = node.targets
    elif isinstance(node, ast.AnnAssign):
        targets = [node.target]
    return ", ".join(map(ast.unparse, targets)) or "its own lines"
