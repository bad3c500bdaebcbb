"""Point clouds: shots of a flight, peaks of their spectra, pairing, and navigation by points."""
