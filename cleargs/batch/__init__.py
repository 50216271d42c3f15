"""Many scenes: read a sheet of scenes, run them, and show them on a page."""
