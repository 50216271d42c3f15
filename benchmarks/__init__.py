"""Programs that measure ClearGS for its documentation. They run from a checkout and are not installed."""
