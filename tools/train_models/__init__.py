"""Recipes that train the two networks ClearGS ships: the restoration expert and the scorer."""
