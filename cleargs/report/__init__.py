"""Reports for users: the page of a run, its live server, and the picture of the allocation."""
