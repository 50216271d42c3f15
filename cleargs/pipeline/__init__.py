"""The runner and its store: which stage must run, where its results lie, and why. Knows nothing of splats."""
