"""Training: priors, targets, losses, augmentation, the loop (paper, sections III-A, III-C and IV-A)."""
