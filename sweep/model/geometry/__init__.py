"""Geometry of a moving lidar: meshes, ray casting, trajectories and scanners."""
