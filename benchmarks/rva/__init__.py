"""Compare evaluators of frames with each other and with the ground truth of synthetic captures."""
