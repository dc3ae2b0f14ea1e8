"""The networks are one table; nothing else knows them by a name of its own."""

import ast
from pathlib import Path

import jaxunshear
from jaxunshear.config.networks import (
    ALL_NETWORKS,
    NETWORKS,
    POSENETS,
    REGISTRY,
    RENDERER,
    TEACHER,
    TRAINABLE,
    UNSHEARING,
    list_networks,
)
from jaxunshear.style import COLOURS

PACKAGE = Path(jaxunshear.__file__).parent
ALSO_KINDS_OF_FILES = {"posenet", "unet", "renderer"}  # of model.json


def test_every_network_is_in_the_table():
    assert set(ALL_NETWORKS) == set(COLOURS)
    assert set(TRAINABLE) == {RENDERER, TEACHER, *ALL_NETWORKS}
    assert {*UNSHEARING, *POSENETS, RENDERER} == set(TRAINABLE)
    learnt = {name for name, spec in REGISTRY.items() if spec.learns_from == "taps"}
    assert learnt == {"posenet", TEACHER, RENDERER}
    assert set(list_networks()) == set(ALL_NETWORKS)
    over_pins = {name for name in ALL_NETWORKS if "pins" in REGISTRY[name].modalities}
    assert over_pins == {*NETWORKS, "posenet_sheared"}


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
        if path != PACKAGE / "config" / "networks.py"
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and node.value in names
    }
    assert not found
