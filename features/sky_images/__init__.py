"""Any photograph of the sky: its stars found, named, and the camera calibrated from them."""
