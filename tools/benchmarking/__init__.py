"""What `tools/benchmark` measures: one module per suite."""
