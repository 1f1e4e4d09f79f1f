"""Cell kernels: radius outliers, DBSCAN."""
