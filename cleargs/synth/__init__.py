"""Synthetic handheld captures with known truth: a procedural room, a handheld path, camera degradations."""
