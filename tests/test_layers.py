"""A step of the data imports the steps before it, and no two files import each other."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
STEPS = (
    "config",
    "results",
    "simulator",
    "perception",
    "data",
    "calibration",
    "models",
    "training",
    "inference",
    "evaluation",
    "downstream",
    "apps",
    "report",
    "sweep",
)
OUTSIDE = ("verification", "benchmarks", "data_specs")  # no wheel has them
FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for folder in ("jaxunshear", *OUTSIDE)
    for path in (ROOT / folder).rglob("*.py")
}


def imported(module: str) -> set[str]:
    """Files of ours that a file imports, at its top or later."""
    found = set()
    for node in ast.walk(ast.parse(FILES[module].read_text())):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = {f"{node.module}.{name.name}" for name in node.names}
            found |= {name if name in FILES else node.module for name in names}
    return found & FILES.keys()


def step_of(module: str) -> int | None:
    package, *parts = module.split(".")
    known = package == "jaxunshear" and parts and parts[0] in STEPS
    return STEPS.index(parts[0]) if known else None


@pytest.mark.parametrize("step", STEPS)
def test_no_step_imports_a_later_one(step):
    mine = [module for module in FILES if step_of(module) == STEPS.index(step)]
    assert len(mine) > 1
    later = {(a, b) for a in mine for b in imported(a) if (step_of(b) or 0) > STEPS.index(step)}
    assert not later


def test_no_two_files_import_each_other():
    """Raises CycleError, which names them."""
    order = list(TopologicalSorter({module: imported(module) for module in FILES}).static_order())
    assert len(order) == len(FILES)
    assert order.index("jaxunshear.errors") < order.index("jaxunshear.cli")


@pytest.mark.parametrize(
    ("user", "others"), [("jaxunshear", OUTSIDE), ("verification", ("benchmarks",))]
)
def test_what_no_wheel_has_can_be_left_out(user, others):
    """A benchmark may import a verification, and both the package; never the other way around."""
    mine = [module for module in FILES if module.split(".")[0] == user]
    assert len(mine) > 10
    assert not {(a, b) for a in mine for b in imported(a) if b.split(".")[0] in others}


def app_of(module: str) -> str:
    """Return the name of the app that a module belongs to, or "" for a module outside apps."""
    parts = module.split(".")
    return parts[2] if parts[1:2] == ["apps"] and len(parts) > 2 else ""


def test_nothing_imports_apps():
    """Only the command of an app, and benchmarks, import it; apps do not import each other."""
    users = {(module, app_of(name)) for module in FILES for name in imported(module)}
    outside = {(module, app) for module, app in users if app and app_of(module) != app}
    commands = {
        ("jaxunshear.cli.apps", "explore"),
        ("jaxunshear.cli.apps", "robot"),
        ("jaxunshear.cli.apps", "export"),
    }
    assert {(module, app) for module, app in outside if "benchmarks" not in module} == commands


def test_config_imports_no_jax():
    """They are read before anything is computed, and by processes that compute nothing."""
    seen, left = set(), [module for module in FILES if step_of(module) == STEPS.index("config")]
    while left:
        module = left.pop()
        seen.add(module)
        left += imported(module) - seen
        text = FILES[module].read_text()
        assert "\nimport jax" not in text and "\nfrom jax " not in text and "flax" not in text, (
            module
        )
    assert {"jaxunshear.config.experiment", "jaxunshear.errors"} <= seen


def test_types_are_named():
    """`Any` stands for what no type says."""
    used = sum(
        getattr(node, "id", getattr(node, "attr", None)) == "Any"
        for path in (ROOT / "jaxunshear").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
    )
    assert 0 < used <= 60


def test_results_are_read_and_written_in_one_place():
    """No other file calls the library that checks them."""
    assert [module for module, path in FILES.items() if "msgspec" in path.read_text()] == [
        "jaxunshear.results.record_files"
    ]


def test_files_and_functions_are_short():
    """And nothing in the package patches another part of it."""
    for module, path in FILES.items():
        text = path.read_text()
        assert text.count("\n") < 373 and "unittest" not in text, module
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                assert node.end_lineno - node.lineno < 66, (module, node.name)
