"""The evaluators of frames against each other, and against known truth."""
