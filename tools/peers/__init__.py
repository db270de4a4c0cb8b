"""Other renderers given the same scene, to compare with."""
