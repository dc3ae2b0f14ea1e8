"""`tactip_recorded`, as TFDS finds it: card, citation and tags lie beside; what builds it is the package's."""

from jaxunshear.dataset.builders.recorded import TactipRecorded


class Builder(TactipRecorded):
    pass
