"""What accuracy costs in time, read from the store of `sweep accuracy`."""
