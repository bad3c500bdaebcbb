"""Physical effects, one a module: the change each makes, and an error bound for leaving it out."""
