"""Images and films of a finished scene: camera paths and output files."""
