"""Forms in which a file holds what an edit does: the cheapest exact one is chosen, sampled rows serve all others."""
