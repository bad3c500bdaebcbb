"""Cost of accuracy: error and computing time of different accuracy settings, on sampled points."""
