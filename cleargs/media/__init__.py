"""Read and write still images, videos and EXR layers, and convert colours."""

_IMAGES = ".jpg .jpeg .jpe .jfif .mpo .png .webp .tif .tiff .bmp .heic .heif .hif .heics .avif .avifs .jxl"
_VIDEOS = ".mp4 .mov .m4v .mkv .webm .avi .mts .m2ts .mpg .3gp"
_OTHERS = (
    ".dng .cr2 .cr3 .nef .nrw .arw .sr2 .raf .orf .rw2 .rwl .pef .srw .gpr .x3f .3fr .iiq "
    ".gif .psd .jp2 .ppm .pgm .hdr"
)

IMAGE_SUFFIXES = frozenset(_IMAGES.split())
"""File endings (lower case) of images."""

VIDEO_SUFFIXES = frozenset(_VIDEOS.split())
"""File endings (lower case) of the videos in a folder. A single video may have any ending."""

RAW_SUFFIXES = frozenset(_OTHERS.split())
"""File endings (lower case) of pictures that are not read."""

MAX_PIXELS = 2**28
"""Most pixels of an image, a mask or a frame of a video: 268 megapixels, more than any phone or camera of
today has. The header of a file of one megabyte may claim a thousand times as many."""
