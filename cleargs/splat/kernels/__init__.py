"""Back ends of the splatting core: ``cpu`` (Numba) and ``cuda`` (Triton)."""
