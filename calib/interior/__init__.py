"""Interior orientation of the remote-sensing camera: focal length, places of its CCDs, distortion, timing."""
