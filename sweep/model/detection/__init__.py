"""Laws of detection: thresholds, noise, speckle, looks, detectors and estimators."""
