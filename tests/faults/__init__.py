"""A campaign of faults, for developers: `make faults`. Nothing of it is installed."""
