"""Writes definitions of this package, with all that they use of it, as the text of one module.

>>> print(collect_source(View))
"""

import ast
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple, TypeGuard

PACKAGE = "jaxunshear"


class _File(NamedTuple):
    lines: list[str]
    definitions: dict[str, ast.stmt]  # by name, at the top
    sources: dict[str, str]  # of what is imported from this package: module by name
    imports: dict[str, str]  # of others: statement by name


def collect_source(*roots: type) -> str:
    """Collect the source of classes, and of what they use but for annotations, in usable order.

    Raises ValueError where two definitions have one name.
    """
    modules: dict[str, str] = {}
    parts: list[str] = []
    imports = {"from __future__ import annotations"}

    def add(module: str, name: str) -> None:
        file = _read_file(module)
        if name in file.sources:
            add(file.sources[name], name)
        elif name in file.imports:
            imports.add(file.imports[name])
        elif name in file.definitions and modules.get(name) != module:
            if name in modules:
                raise ValueError(f"{name} is defined in {modules[name]} and in {module}")
            modules[name] = module
            for used in _list_names(file.definitions[name]):
                add(module, used)
            parts.append(_cut(file, file.definitions[name]))

    for root in roots:
        add(root.__module__, root.__name__)
    return "\n".join(sorted(imports)) + "\n\n\n" + "\n\n\n".join(dict.fromkeys(parts)) + "\n"


@cache
def _read_file(module: str) -> _File:
    spec = find_spec(module)
    assert spec is not None and spec.origin is not None
    text = Path(spec.origin).read_text("utf-8")
    tree = ast.parse(text)
    file = _File(text.splitlines(), {}, {}, {})
    for node in ast.walk(tree):
        if _is_ours(node):
            file.sources.update({alias.name: node.module or "" for alias in node.names})
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            file.definitions[node.name] = node
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [name for target in targets for name in _list_names(target)]
            file.definitions.update(dict.fromkeys(names, node))
        elif isinstance(node, ast.Import | ast.ImportFrom):
            for alias in node.names:
                one: ast.stmt = ast.Import([alias])
                if isinstance(node, ast.ImportFrom):
                    one = ast.ImportFrom(node.module, [alias], node.level)
                file.imports[alias.asname or alias.name] = ast.unparse(one)
    return file


def _is_ours(node: ast.AST) -> TypeGuard[ast.ImportFrom]:
    return isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == PACKAGE


def _list_names(node: ast.AST) -> Iterator[str]:
    """Yield the names in a statement, but for annotations."""
    if isinstance(node, ast.Name):
        yield node.id
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _list_names(child)


def _cut(file: _File, node: ast.stmt) -> str:
    """Cut a statement out of its file, without its imports from this package."""
    first = min([node, *getattr(node, "decorator_list", [])], key=lambda each: each.lineno)
    dropped = {
        line
        for each in ast.walk(node)
        if _is_ours(each)
        for line in range(each.lineno, (each.end_lineno or 0) + 1)
    }
    numbers = range(first.lineno, (node.end_lineno or 0) + 1)
    return "\n".join(file.lines[line - 1] for line in numbers if line not in dropped)
