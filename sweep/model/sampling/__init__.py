"""Random draws: random numbers, random effects, noise and full noisy spectra."""
