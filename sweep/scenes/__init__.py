"""Scenes as arrays for the model: files, random terrain and the objects on it."""
