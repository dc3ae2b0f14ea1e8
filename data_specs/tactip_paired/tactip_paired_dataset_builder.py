"""`tactip_paired`, as TFDS finds it: card, citation and tags lie beside; what builds it is the package's."""

from jaxunshear.dataset.builders.paired import TactipPaired


class Builder(TactipPaired):
    pass
