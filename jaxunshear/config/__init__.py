"""Settings of experiments and sweeps, and the rules for them; imports no JAX."""
