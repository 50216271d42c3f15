"""ClearGS: clean 3D Gaussian Splatting scenes from handheld videos of mixed quality."""

__version__ = "0.1.0"
