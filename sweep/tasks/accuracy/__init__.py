"""Cost of accuracy in time: a ladder of settings, tried on some points of a study."""
