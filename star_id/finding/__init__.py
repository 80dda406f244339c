"""Stars of a raw image: detection, width of the PSF, centroids with covariances. `star_list.find_stars` runs
it."""
