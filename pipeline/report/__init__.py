"""Self-contained HTML pages and plots of a result, made from the files that `calibrate` saved."""
