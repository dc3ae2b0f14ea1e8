"""Recordings of a sensor's own as a data set: `jaxunshear data FILE --recordings DIR` builds it."""

from data_specs.tactip_recorded.tactip_recorded_dataset_builder import Builder as Builder
