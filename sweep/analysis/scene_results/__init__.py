"""Results of flights: point clouds and navigation, read from stores, drawn and exported."""
