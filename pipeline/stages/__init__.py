"""A pixel's way: exposure to star sightings, strip to ground sightings, each as a unit of work."""
