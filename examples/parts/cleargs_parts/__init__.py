"""Parts that ClearGS finds through the entry points in pyproject.toml: a file a part."""
