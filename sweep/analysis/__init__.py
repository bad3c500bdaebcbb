"""Datasets, figures and tables of stores. Reads stores, runs nothing."""
