"""Back ends of the splatting core: ``reference`` (float64 oracle), ``cpu`` (Numba) and ``cuda`` (Triton)."""
