"""Scenes as computed: point clouds and navigation, read from stores and drawn."""
