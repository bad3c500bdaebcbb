"""Spectra of segments: lines, their shapes, the bins around them, and leakage far from them."""
