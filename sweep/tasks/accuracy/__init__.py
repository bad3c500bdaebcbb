"""Cost of accuracy in time: a ladder of settings, tried on a sample of a study's points."""
