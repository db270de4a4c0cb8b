"""Edits of indirect light: what they are, and what they do to a pair of samples."""
