"""Scenes as the model's arrays: files read, ground drawn at random, and the objects on it."""
