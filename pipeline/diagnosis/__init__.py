"""From what became of the observations, and the estimate, to findings about the inputs."""
