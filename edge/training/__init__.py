"""Training: priors, targets, losses, augmentation, the loop (paper, sections III-B to III-D)."""
