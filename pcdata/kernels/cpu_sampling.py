"""Sampling kernels: deprojection, planes, voxels, farthest points."""
