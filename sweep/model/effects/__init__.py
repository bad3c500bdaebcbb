"""Physical effects, one a module: what each does, and what leaving it out can change at most."""
