"""What a store says: datasets, figures and tables. Reads stores, runs nothing."""
