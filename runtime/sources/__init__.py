"""Where stereo frames come from: KITTI layouts, image files, video, cameras; one source a file."""
