"""Mutated sidecars and layers, each read in a child process that may be killed: see `tools/fuzz`."""
