"""`tactip_recorded`, as TFDS finds it: card, citation and tags lie beside; what builds it is the package's."""

import tensorflow_datasets as tfds

from jaxunshear.data.builders.recorded import TactipRecorded


class Builder(TactipRecorded):
    # else TFDS takes that of the class above, once it has been asked for
    pkg_dir_path = tfds.core.Path(__file__).parent
