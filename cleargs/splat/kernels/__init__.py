"""Back ends of the splatting core: ``reference`` (float64 oracle) and ``cpu`` (Numba)."""
