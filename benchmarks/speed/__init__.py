"""Time, memory and error of the splatting core and of whole runs."""
