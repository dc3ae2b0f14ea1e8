"""Make `tactip_recorded` known to TFDS, with the card, citation and tags that lie beside."""

import tensorflow_datasets as tfds

from jaxunshear.data.builders import TactipRecorded


class Builder(TactipRecorded):
    # else TFDS takes the folder of the parent class, once it has been read
    pkg_dir_path = tfds.core.Path(__file__).parent
