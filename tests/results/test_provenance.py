"""With which code networks were trained, as far as they say so."""

import json
import platform
from dataclasses import replace

import pytest

from jaxunshear.files import to_builtins
from jaxunshear.results.measurement import Machine, Source, TrainingSummary
from jaxunshear.results.provenance import describe_machine, list_versions, read_training_facts
from jaxunshear.results.record_files import convert_record, write_record
from jaxunshear.results.run import Results

NOW = Source("0.3.0", "2030-01-02", "c", True)
EARLIER = replace(NOW, commit="b")
SUMMARY = TrainingSummary(
    steps=1, parameters=1, best_step=1, train_seconds=1.0, images_per_second=1.0
)
EMPTY = Results(settings={}, metric={}, pin_error={})


def test_what_trainings_say_is_read(tmp_path):
    made = replace(SUMMARY, trained_on=Machine(cores=2), trained_by=EARLIER)
    write_record(tmp_path / "disentangled" / "summary.json", made)
    earlier = replace(SUMMARY, trained_on=Machine(cores=4))
    write_record(tmp_path / "posenet" / "summary.json", earlier)
    found = read_training_facts(tmp_path, ("disentangled", "posenet", "absent"))
    assert found["trained_by"] == {"disentangled": EARLIER}
    assert [found["trained_on"][name].cores for name in ("disentangled", "posenet")] == [2, 4]


@pytest.mark.parametrize(
    ("held", "expected"),
    [
        ({"source": NOW, "trained_by": {"posenet": EARLIER}}, [NOW, EARLIER]),
        ({"source": NOW}, [NOW]),
        # trained before commits were kept
        ({"source": NOW, "trained_on": {"posenet": Machine()}}, []),
        ({"trained_by": {"posenet": EARLIER}}, []),
    ],
)
def test_code_is_known_of_all_or_not_at_all(held, expected):
    assert replace(EMPTY, **held).sources == expected


def test_machine_is_plain_and_says_something():
    found = describe_machine()
    assert found.cores >= 1
    assert found.processor
    assert found.device.count(":") >= 1
    stored = json.loads(json.dumps(to_builtins(found)))
    assert convert_record(stored, Machine, "it", "again") == found


def test_versions_name_python_and_jax():
    import jax

    found = list_versions()
    assert found["python"] == platform.python_version()
    assert found["jax"] == jax.__version__
