"""Training of the networks in the package: the restoration expert and the scorers."""
