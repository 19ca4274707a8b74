"""Where results go: JSON lines, KITTI text, pictures and video; one sink a file."""
