"""Answers from a store in the field's words: ranges, ROC curves, alarm rates, comparisons."""
