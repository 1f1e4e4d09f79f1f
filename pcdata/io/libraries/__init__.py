"""Clouds, meshes and cameras as other libraries hold them in memory: Open3D, PyTorch Geometric."""
