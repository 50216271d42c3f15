"""Pictures in and out: still images, videos, EXR layers, colour."""

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"})
"""File endings (lower case) taken for images."""

MAX_PIXELS = 2**28
"""Most pixels of an image, a mask or a frame of a video: 268 megapixels, more than any phone or camera of
today has. A file of one megabyte may claim a thousand times as many."""
