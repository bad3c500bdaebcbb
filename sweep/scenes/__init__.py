"""Files that scenes are made of, read into the model's arrays."""
