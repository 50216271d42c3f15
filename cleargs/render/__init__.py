"""Pictures and films of a finished scene: where the camera goes, and what is written."""
