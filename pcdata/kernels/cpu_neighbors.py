"""Neighbour kernels: kNN, ball query, statistical outliers, normals."""
