"""Random draws: generators of numbers, random effects, noise and whole noisy spectra."""
