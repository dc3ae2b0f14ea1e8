"""The machine and the versions beside each measurement."""

import json
import platform

import jax

from jaxunshear.metrics.machine import describe_machine, list_versions
from jaxunshear.results.measurement import Machine
from jaxunshear.results.record_files import convert_record
from jaxunshear.serialization import to_builtins


def test_machine_is_plain_and_says_something():
    found = describe_machine()
    assert found.cores >= 1 and found.processor and found.device.count(":") >= 1
    plain = json.loads(json.dumps(to_builtins(found)))
    assert convert_record(plain, Machine, "it", "again") == found


def test_versions_name_python_and_jax():
    found = list_versions()
    assert (found["python"], found["jax"]) == (platform.python_version(), jax.__version__)
