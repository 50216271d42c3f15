"""Synthetic handheld captures with ground truth: a procedural room, a handheld path, camera degradations."""
