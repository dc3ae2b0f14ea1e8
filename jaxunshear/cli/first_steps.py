"""Commands that need neither recordings nor a training: demo-data."""

import argparse

from jaxunshear.cli.program import Command, integer, path

NEXT_STEPS = """\
{folder}: 331_pins and 127_pins, each with edge (taps and slides), camera and untouched; try
  jaxunshear doctor {folder}/331_pins/edge
  jaxunshear fit --taps {folder}/331_pins/edge/tap --slides {folder}/331_pins/edge/shear \
--unshear.input pins"""


def write_demo_data(arguments: argparse.Namespace, command: str) -> int:
    from jaxunshear.demo_data import write_demo_data

    write_demo_data(arguments.folder, arguments.contacts, arguments.seed)
    print(NEXT_STEPS.format(folder=arguments.folder))
    return 0


COMMANDS = (
    Command(
        "demo-data",
        "write a small labelled recording, simulated, to try the other commands on",
        write_demo_data,
        (
            path("folder", "DIR", "a new or an empty folder"),
            integer(
                "--contacts", "taps, and as many slides, of 331 pins; 127 pins: a fifth (300)", 300
            ),
            integer("--seed", "seed of poses, slides and noise (default: 0)", 0),
        ),
    ),
)
