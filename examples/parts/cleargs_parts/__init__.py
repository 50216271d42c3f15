"""Plugins that ClearGS finds through the entry points in pyproject.toml, one per file."""
