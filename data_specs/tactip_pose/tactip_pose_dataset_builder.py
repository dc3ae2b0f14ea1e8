"""`tactip_pose`, as TFDS finds it: card, citation and tags lie beside; what builds it is the package's."""

from jaxunshear.dataset.builders.pose import TactipPose


class Builder(TactipPose):
    pass
