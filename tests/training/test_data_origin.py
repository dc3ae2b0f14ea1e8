"""A network that learnt from other data than the experiment's is refused by what differs."""

from dataclasses import replace

import pytest

from jaxunshear.config.data import PairedData
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.network_config import resolve_network
from jaxunshear.data.sources import open_source
from jaxunshear.errors import UserError
from jaxunshear.files import write_json
from jaxunshear.training.provenance import check_origin

SIMULATED = Experiment(name="small", claim="none", networks=("disentangled",))


def test_a_network_of_other_data_is_refused(tmp_path):
    own = open_source(SIMULATED).describe_origin(resolve_network(SIMULATED, "disentangled"))
    write_json(tmp_path / "disentangled" / "model.json", {"origin": own})
    check_origin(SIMULATED, "disentangled", tmp_path)
    other = replace(SIMULATED, paired=PairedData(seed=7))
    with pytest.raises(UserError, match=r"another settings\.seed: give another --out"):
        check_origin(other, "disentangled", tmp_path)
    write_json(tmp_path / "disentangled" / "model.json", {"origin": own | {"version": "2.4.0"}})
    with pytest.raises(UserError, match="another version"):
        check_origin(SIMULATED, "disentangled", tmp_path)
