"""Answers from a store: detection ranges, ROC curves, false-alarm rates, errors, comparisons."""
