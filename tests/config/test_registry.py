"""The networks are one table; nothing else knows them by a name of its own."""

import ast
from pathlib import Path
from typing import get_args

import jaxunshear
from jaxunshear.config.registry import (
    ALL_NETWORKS,
    PIN_NETWORKS,
    POSENETS,
    REGISTRY,
    RENDERER,
    TAP_NETWORKS,
    TEACHER,
    TRAINABLE,
    UNSHEARING,
    Network,
)
from jaxunshear.style import COLOURS

PACKAGE = Path(jaxunshear.__file__).parent
ALSO_KINDS_OF_FILES = {"posenet", "unet", "renderer"}  # `training.checkpoint.NETS`


def test_every_network_is_in_the_table():
    assert set(get_args(Network)) == set(ALL_NETWORKS) == set(COLOURS)
    assert set(TRAINABLE) == {RENDERER, TEACHER, *ALL_NETWORKS}
    assert {*UNSHEARING, *POSENETS, RENDERER} == set(TRAINABLE)
    assert set(TAP_NETWORKS) == {"posenet", TEACHER, RENDERER}
    assert set(PIN_NETWORKS) == {"entangled", "disentangled", "posenet", "posenet_sheared"}


def test_those_that_unshear_are_titled():
    assert all(
        REGISTRY[name].title and REGISTRY[name].learns_from == "pairs" for name in UNSHEARING
    )


def test_no_other_file_spells_a_networks_name():
    """Docstrings and comments may."""
    names = REGISTRY.keys() - ALSO_KINDS_OF_FILES
    found = {
        (str(path.relative_to(PACKAGE)), node.value)
        for path in PACKAGE.rglob("*.py")
        if path != PACKAGE / "config" / "registry.py"
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and node.value in names
    }
    assert not found
