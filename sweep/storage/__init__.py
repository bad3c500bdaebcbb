"""Places of stores, on disk or in an object store, and their logs and documents."""
