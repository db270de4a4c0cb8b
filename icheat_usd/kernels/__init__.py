"""Every Numba kernel of the package, and nothing that is not one."""
