"""`tactip_pose`, as TFDS finds it: card, citation and tags lie beside; what builds it is the package's."""

import tensorflow_datasets as tfds

from jaxunshear.dataset.builders.pose import TactipPose


class Builder(TactipPose):
    pkg_dir_path = tfds.core.Path(
        __file__
    ).parent  # else TFDS takes that of the class above, once it has been asked for
