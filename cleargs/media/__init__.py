"""Pictures in and out: still images, videos, EXR layers, colour."""

IMAGE_SUFFIXES = frozenset(
    {".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif", ".avif", ".jxl"}
)
"""File endings (lower case) of images."""

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".m2ts", ".mpg", ".3gp"})
"""File endings (lower case) of the videos in a folder. A video that is given as such may have any."""

RAW_SUFFIXES = frozenset({".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".gif"})
"""File endings (lower case) of pictures that are not read."""

MAX_PIXELS = 2**28
"""Most pixels of an image, a mask or a frame of a video: 268 megapixels, more than any phone or camera of
today has. A file of one megabyte may claim a thousand times as many."""
