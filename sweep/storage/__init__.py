"""Locations of stores, on disk or in an object store, and the format of their files and logs."""
