"""The runner and the store of results. They decide which stages run; they know nothing of splats."""
