"""Stars of a raw image: detection, width of the PSF, centroids with covariances. `star_list.list_stars` runs
it."""
