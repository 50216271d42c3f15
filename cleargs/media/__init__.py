"""Pictures in and out: still images, videos, EXR layers, colour."""

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"})
"""File endings (lower case) taken for images."""
