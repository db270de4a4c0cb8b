"""The home of ``pxr``: what a stage holds becomes a snapshot, and edits become opinions."""
