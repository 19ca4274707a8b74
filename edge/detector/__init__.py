"""The detector YOLOStereo3D as a torch module, its presets and its weights (paper, section III)."""
