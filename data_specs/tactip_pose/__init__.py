"""Make the set known to TFDS: `tfds.builder("tactip_pose/demo", data_dir=...)`."""

from data_specs.tactip_pose.tactip_pose_dataset_builder import Builder as Builder
