"""A target's position to a few thousandths of a pixel, with its covariance."""
