"""What each pixel of a frame shows, by rays cast at a scene's mesh and by the measured depth."""
