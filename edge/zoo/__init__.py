"""Model zoo: bundled weights and models, and what belongs to a checkpoint."""
