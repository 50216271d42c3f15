"""Programs that measure ClearGS, for its own pages. They run from a checkout and are not installed."""
