"""Report of a study: one HTML page that opens in a browser without a network."""
