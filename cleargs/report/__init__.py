"""Reports for users: the page of a run, and the server that shows its progress."""
