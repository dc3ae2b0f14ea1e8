"""`import data_specs.tactip_paired` makes the set known to `tfds.builder("tactip_paired/demo", data_dir=...)`."""

from data_specs.tactip_paired.tactip_paired_dataset_builder import Builder as Builder
