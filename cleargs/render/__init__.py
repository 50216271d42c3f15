"""Images and films of a finished scene: camera paths and output files."""

PROGRAMS = ("blender", "unreal", "unity", "supersplat", "web")
"""Programs of ``cleargs export --for``."""
