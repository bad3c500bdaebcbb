"""The geometry that a moving lidar sees: meshes, the rays cast into them, paths and scanners."""
