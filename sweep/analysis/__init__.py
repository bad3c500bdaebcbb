"""Datasets, figures and tables made from stores; nothing here runs a study."""
