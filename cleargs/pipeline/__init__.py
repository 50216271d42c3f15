"""The runner, which decides which stages run, and the store of results. Both are independent of splats."""
