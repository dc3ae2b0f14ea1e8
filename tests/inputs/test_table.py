"""The table of inputs as one: each row is there once, and says what it is."""

import importlib
import pkgutil

from tests import inputs


def read_table():
    names = [module.name for module in pkgutil.iter_modules(inputs.__path__)]
    modules = [importlib.import_module(f"tests.inputs.{name}") for name in names]
    return [case for module in modules for case in getattr(module, "CASES", ())]


def test_each_row_is_there_once():
    rows = [(case.door, case.name) for case in read_table()]
    assert len(set(rows)) == len(rows)


def test_each_row_names_its_answer():
    assert all(case.name and case.door and case.answer for case in read_table())
