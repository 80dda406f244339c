"""From a raw image to its stars: where they are, how bright, how well placed."""
