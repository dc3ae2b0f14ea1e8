"""The machine and the versions beside each measurement."""

import json
import platform

from jaxunshear.files import to_builtins
from jaxunshear.metrics.machine import describe_machine, list_versions
from jaxunshear.results.measurement import Machine
from jaxunshear.results.record_files import convert_record


def test_machine_is_plain_and_says_something():
    found = describe_machine()
    assert found.cores >= 1
    assert found.processor
    assert found.device.count(":") >= 1
    assert (
        convert_record(json.loads(json.dumps(to_builtins(found))), Machine, "it", "again") == found
    )


def test_versions_name_python_and_jax():
    import jax

    found = list_versions()
    assert found["python"] == platform.python_version()
    assert found["jax"] == jax.__version__
