"""Time, memory and error of the rasteriser, its training steps and whole runs."""
