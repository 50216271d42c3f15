"""Densification: how the number and the places of Gaussians change during a training."""
