"""Make the set known to TFDS: `tfds.builder("tactip_paired/demo", data_dir=...)`."""

from data_specs.tactip_paired.tactip_paired_dataset_builder import Builder as Builder
