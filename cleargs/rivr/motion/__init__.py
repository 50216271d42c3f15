"""What the camera did while a frame was taken, found with the scene's help, and the frame without it."""
