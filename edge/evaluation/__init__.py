"""How good detections are: KITTI average precision, agreement of two models, errors by distance."""
