"""Render-guided in-video restoration: candidates, choice, gates and distillation."""
