"""The evaluator ``qwen3-vl``: appearance cues from a vision-language model, one image per question."""
