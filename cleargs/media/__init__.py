"""Pictures in and out: still images, videos, EXR layers, colour."""
